// Elements, and numbers as a person reads them: the same rules as bench/pages/text_format.py.

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "on") for (const [event, act] of Object.entries(value)) made.addEventListener(event, act);
    else if (value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  // Texts become text nodes: whatever they hold, it is no markup.
  made.append(...children.filter((child) => child !== null));
  return made;
}

function shapes(tag, attributes) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

const RAISED = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };

function raised(exponent) {
  return [...String(exponent)].map((digit) => RAISED[digit]).join("");
}

function signed(text) {
  return /[1-9]/.test(text) ? text.replaceAll("-", "−") : text.replace(/^-+/, "");
}

function readable(value, digits = 3) {
  if (value === null || Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  if (value === 0) return "0";
  const rounded = Number(value.toExponential(digits - 1));
  const size = Math.abs(rounded);
  const decade = Math.floor(Math.log10(size) + 1e-12);
  const exponent = size >= 1e-3 && size < 1e5 ? 0 : decade;
  const decimals = Math.max(0, digits - 1 - decade + exponent);
  let text = (rounded / 10 ** exponent).toFixed(decimals);
  if (text.includes(".")) text = text.replace(/0+$/, "").replace(/\.$/, "");
  return signed(text) + (exponent ? `×10${raised(exponent)}` : "");
}

function between(low, high) {
  return `${readable(low)} to ${readable(high)}`;
}

function save(name, type, content) {
  const address = content instanceof Blob ? URL.createObjectURL(content) : URL.createObjectURL(new Blob([content], { type }));
  const link = element("a", { href: address, download: name });
  link.click();
  // The browser has begun to save by then.
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}

async function copied(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    // Older browsers, and those that keep the clipboard from files.
    const area = element("textarea", { class: "away" });
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    return done;
  }
}
