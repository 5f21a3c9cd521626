// The page as a whole: light and dark, sections, figures and tables.

const root = document.documentElement;
root.classList.add("scripted");

function addTheme() {
  const pick = element("select", { id: "theme", on: { change: () => state.set("theme", pick.value) } },
    ...[["", "system"], ["light", "light"], ["dark", "dark"]].map(([value, text]) => element("option", { value }, text)));
  document.querySelector("nav").append(element("label", { class: "theme" }, "theme ", pick));
  return pick;
}

function applyTheme(pick) {
  const theme = state.get("theme");
  if (theme) root.dataset.theme = theme;
  else delete root.dataset.theme;
  pick.value = theme;
}

const themePick = addTheme();
applyTheme(themePick);
FIGURES.push(...DATA.charts.map((spec) => new FigureView(spec)));
for (const place of document.querySelectorAll("figure.picture")) filesOf(place, place.id, (place.dataset.tables ?? "").split(" ").filter(Boolean));
const PARTS = [...FIGURES, ...DATA.grids.map((spec) => new GridView(spec))];

state.listen((key) => {
  if (key === "theme") applyTheme(themePick);
  for (const part of PARTS) if (part.concerns(key)) part.changed(key);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => FIGURES.forEach((figure) => figure.changed()));

// What bears the same name lights up together: a joint in a list, its curves, its place in a picture.
function light(event) {
  const name = event.target.closest?.("[data-lights]")?.dataset.lights;
  for (const one of document.querySelectorAll("[data-lights]")) one.classList.toggle("lit", one.dataset.lights === name);
}
for (const happens of ["mouseover", "focusin"]) document.addEventListener(happens, light);

// What is to be typed elsewhere is copied with a click.
for (const text of document.querySelectorAll("pre.copied")) {
  const button = element("button", { type: "button", class: "copy", on: { click: async () => {
    button.textContent = (await copied(text.textContent)) ? "copied" : "not copied";
    setTimeout(() => { button.textContent = "copy"; }, 1500);
  } } }, "copy");
  const frame = element("div", { class: "copying" });
  text.replaceWith(frame);
  frame.append(text, button);
}

// The address holds the view: a link to a section goes there and leaves the view as it is.
for (const link of document.querySelectorAll('a[href^="#"]')) {
  link.addEventListener("click", (event) => {
    const goal = document.getElementById(link.hash.slice(1));
    if (!goal) return;
    event.preventDefault();
    goal.scrollIntoView();
    goal.setAttribute("tabindex", "-1");
    goal.focus({ preventScroll: true });
    state.set("at", link.hash.slice(1));
  });
}
if (state.get("at")) document.getElementById(state.get("at"))?.scrollIntoView();
window.addEventListener("hashchange", () => {
  state.read();
  applyTheme(themePick);
  PARTS.forEach((part) => part.changed());
});
