// A table that is sorted, filtered, copied and saved.

class GridView {
  constructor(spec) {
    this.spec = spec;
    this.held = table(spec.table);
    this.place = document.getElementById(spec.name);
    this.place.querySelectorAll("p.soft").forEach((note) => note.remove());
    this.body = this.place.querySelector("tbody");
    this.count = element("span", { class: "count", "aria-live": "polite" });
    this.addTools();
    this.addHeads();
    this.draw();
  }

  key(name) {
    return `${this.spec.name}.${name}`;
  }

  addTools() {
    const { spec } = this;
    const words = element("input", { type: "search", value: state.get(this.key("words")), on: { input: () => state.set(this.key("words"), words.value) } });
    this.words = words;
    this.picks = spec.filters.map((name) => {
      const values = [...new Set(this.held.column(name))];
      const pick = element("select", { on: { change: () => state.set(this.key(name), pick.value, spec.only[name] ?? "") } },
        element("option", { value: "" }, "all"), ...values.filter(Boolean).map((value) => element("option", { value }, value)));
      return [name, pick];
    });
    const button = (text, act) => element("button", { type: "button", on: { click: act } }, text);
    const copy = button("copy", async () => {
      const done = await copied(this.text());
      copy.textContent = done ? "copied" : "not copied";
      setTimeout(() => { copy.textContent = "copy"; }, 1500);
    });
    this.more = button("", () => state.set(this.key("rows"), state.get(this.key("rows")) ? "" : "all"));
    const tools = element("div", { class: "controls" },
      element("label", {}, "search ", words),
      ...this.picks.map(([name, pick]) => element("label", {}, `${name} `, pick)),
      copy,
      button("save as CSV", () => save(`${spec.table}.csv`, "text/csv", this.held.text)),
      this.count);
    this.place.querySelector("h3").after(tools);
    this.place.append(this.more);
  }

  addHeads() {
    this.heads = [...this.place.querySelectorAll("thead th")];
    this.heads.forEach((head, i) => {
      const { name, says } = this.spec.columns[i];
      const button = element("button", { type: "button", title: says || "sort by this column", on: { click: () => this.sortBy(name) } }, ...head.childNodes);
      head.replaceChildren(button);
    });
  }

  sorting() {
    const [name, way] = state.get(this.key("sort"), this.spec.sort).split(",");
    return { name, down: way === "down" };
  }

  // First upwards, then downwards, then as it stood.
  sortBy(name) {
    const now = this.sorting();
    const next = now.name !== name ? name : now.down ? "" : `${name},down`;
    state.set(this.key("sort"), next, this.spec.sort);
  }

  rows() {
    const { spec, held } = this;
    const words = state.get(this.key("words")).toLowerCase().split(/\s+/).filter(Boolean);
    const off = spec.switch ? state.off() : new Set();
    const wanted = {};
    for (const name of spec.filters) {
      const value = state.get(this.key(name), spec.only[name] ?? "");
      if (value) wanted[name] = value;
    }
    const shown = spec.columns.map(({ name }) => held.places.get(name));
    const found = held.where(wanted).filter((row) => {
      const texts = held.rows[row];
      if (off.size && off.has(texts[held.places.get(spec.switch)])) return false;
      if (!words.length) return true;
      const all = shown.map((place) => texts[place]).join(" ").toLowerCase();
      return words.every((word) => all.includes(word));
    });
    const { name, down } = this.sorting();
    if (!held.places.has(name)) return found;
    const numeric = spec.columns.find((column) => column.name === name)?.digits;
    const values = numeric ? held.values(name) : held.column(name);
    // What has no number comes last, whichever way.
    const order = (a, b) => {
      const [x, y] = [values[a], values[b]];
      if (!numeric) return x < y ? -1 : x > y ? 1 : 0;
      if (Number.isNaN(x) || Number.isNaN(y)) return (Number.isNaN(x) - Number.isNaN(y)) * (down ? -1 : 1);
      return x - y || 0;
    };
    found.sort((a, b) => (down ? order(b, a) : order(a, b)) || a - b);
    return found;
  }

  // Whether a row stands out, and what it lights up with.
  standing(row) {
    const { spec, held } = this;
    const text = (name) => held.rows[row][held.places.get(name)];
    const found = spec.marked.length && text(spec.marked[0]).startsWith(spec.marked[1]);
    return { class: found && "found", "data-lights": (spec.lights && text(spec.lights)) || false };
  }

  cell(row, { name, digits }, place) {
    const { held, spec } = this;
    const text = held.rows[row][held.places.get(name)];
    const shown = digits ? readable(held.values(name)[row], digits) : text;
    const address = spec.links && !place && held.rows[row][held.places.get(spec.links)];
    return address ? element("a", { href: address }, shown) : shown;
  }

  draw() {
    const { spec, held } = this;
    for (const [name, pick] of this.picks) pick.value = state.get(this.key(name), spec.only[name] ?? "");
    if (document.activeElement !== this.words) this.words.value = state.get(this.key("words"));
    const rows = this.rows();
    const every = state.get(this.key("rows")) === "all";
    const shown = every ? rows : rows.slice(0, spec.few);
    this.body.replaceChildren(...shown.map((row) =>
      element("tr", this.standing(row), ...spec.columns.map((column, i) => element("td", { class: column.digits ? "number" : false }, this.cell(row, column, i))))));
    const { name, down } = this.sorting();
    this.heads.forEach((head, i) => {
      if (spec.columns[i].name === name) head.setAttribute("aria-sort", down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
    this.count.textContent = `${rows.length} of ${held.rows.length} rows`;
    this.more.hidden = rows.length <= spec.few;
    this.more.textContent = every ? `show ${spec.few} rows` : `show all ${rows.length} rows`;
  }

  // What is shown, with all digits, as spreadsheets take it.
  text() {
    const names = this.spec.columns.map(({ name }) => name);
    const places = names.map((name) => this.held.places.get(name));
    const clean = (text) => text.replace(/[\t\r\n]+/g, " ");
    return [names, ...this.rows().map((row) => places.map((place) => clean(this.held.rows[row][place])))].map((line) => line.join("\t")).join("\n");
  }

  changed() {
    this.draw();
  }

  concerns(key) {
    return (key === "off" && Boolean(this.spec.switch)) || key.startsWith(`${this.spec.name}.`);
  }
}
