// Files that are saved from the page.

// SVG and PNG from the printed figure, or PNG alone where that is what the page holds; the numbers
// from the tables.
function filesOf(place, own, tables) {
  const still = place.querySelector("img.still");
  const files = place.querySelector(".files") ?? element("p", { class: "files" });
  const button = (text, act) => element("button", { type: "button", on: { click: act } }, text);
  const made = [];
  if (still) {
    const name = still.dataset.file;
    const vector = still.src.startsWith("data:image/svg");
    if (vector) made.push(button("SVG", () => fileOf(still.src, "image/svg+xml").then((blob) => save(`${name}.svg`, "", blob))));
    const png = () => (vector ? pixels(still) : fileOf(still.src, "image/png"));
    made.push(button("PNG", () => png().then((blob) => save(`${name}.png`, "", blob))));
  }
  for (const name of tables) {
    made.push(button(`numbers as CSV${name === own ? "" : ` (${name})`}`, () => save(`${name}.csv`, "text/csv", DATA.tables[name])));
  }
  files.prepend("Save this figure: ");
  files.append(...made);
  return files;
}

// The bytes of an image that lies in the page; nothing is asked of anybody.
async function fileOf(source, type) {
  const text = atob(source.slice(source.indexOf(",") + 1));
  return new Blob([Uint8Array.from(text, (letter) => letter.charCodeAt(0))], { type });
}

async function pixels(still) {
  const image = new Image();
  image.src = still.src;
  await image.decode();
  const canvas = element("canvas", { width: 2 * image.naturalWidth, height: 2 * image.naturalHeight });
  const ctx = canvas.getContext("2d");
  ctx.fillStyle = "#ffffff";
  ctx.fillRect(0, 0, canvas.width, canvas.height);
  ctx.drawImage(image, 0, 0, canvas.width, canvas.height);
  return new Promise((done) => canvas.toBlob(done, "image/png"));
}
