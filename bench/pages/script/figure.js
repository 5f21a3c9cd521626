// A figure: its controls, its legend and the panels that are chosen.

const AXES = { x: "across", y: "up" };
const NAMES = { linear: "linear", log: "logarithmic", symlog: "logarithmic" };
const WHOLE = "all";

class FigureView {
  constructor(spec) {
    this.spec = spec;
    this.place = document.getElementById(spec.name);
    this.live = this.place.querySelector(".live");
    this.views = [];
    const facets = this.facetsOf(spec.panels);
    this.facets = facets.filter(([name]) => !spec.toggles.includes(name));
    this.toggles = facets.filter(([name]) => spec.toggles.includes(name));
    this.controls = element("div", { class: "controls" });
    this.legend = element("div", { class: "legend", role: "group", "aria-label": "series: click to switch on and off, with Shift for one alone" });
    this.switches = this.toggles.map(([name]) => element("div", { class: "legend switches", role: "group", "aria-label": `${name}: click to switch on and off, with Shift for one alone` }));
    this.panels = element("div", { class: "panels" });
    this.told = element("p", { class: "told", "aria-live": "polite" });
    this.live.append(this.controls, ...this.switches, this.legend, this.panels, this.told);
    this.addFiles();
    this.draw();
    new ResizeObserver(() => this.resized()).observe(this.live);
    this.near = true;
    new IntersectionObserver((happened) => this.moved(happened.at(-1).isIntersecting), { rootMargin: "300px 0px" }).observe(this.live);
  }

  // What concerns all figures was chosen, or, where there is a key, maybe this one alone. What
  // nobody sees is drawn when it comes into sight, so that no click waits for it.
  changed(key = "") {
    if (this.near || this.owns(key)) this.draw();
    else {
      this.old = true;
      this.addChoices(this.shown());
    }
  }

  moved(near) {
    this.near = near;
    if (near && this.old) this.draw();
  }

  key(name) {
    return `${this.spec.name}.${name}`;
  }

  facetsOf(panels) {
    const found = new Map();
    for (const panel of panels) {
      for (const [name, value] of Object.entries(panel.facets)) found.set(name, (found.get(name) ?? new Set()).add(value));
    }
    return [...found].filter(([, values]) => values.size > 1).map(([name, values]) => [name, [...values]]);
  }

  chosen(name, values) {
    const first = name === this.spec.side_by_side ? WHOLE : values[0];
    const value = state.get(this.key(name), first);
    return value === WHOLE || values.includes(value) ? value : first;
  }

  // Values of a toggle that are on.
  on(name, values) {
    const key = this.key(name);
    const off = this.spec.off[name] ?? [];
    if (!state.get(key)) return new Set(values.filter((value) => !off.includes(value)));
    return new Set(state.get(key).split(",").map(decodeURIComponent).filter((value) => values.includes(value)));
  }

  switchOn(name, values, on) {
    const text = (wanted) => values.filter((value) => wanted.has(value)).map(encodeURIComponent).join(",") || "-";
    const off = this.spec.off[name] ?? [];
    const first = new Set(values.filter((value) => !off.includes(value)));
    state.set(this.key(name), text(on) === text(first) ? "" : text(on));
  }

  shown() {
    const picks = this.facets.map(([name, values]) => [name, this.chosen(name, values)]);
    const on = this.toggles.map(([name, values]) => [name, this.on(name, values)]);
    return this.spec.panels.filter((panel) =>
      picks.every(([name, value]) => value === WHOLE || panel.facets[name] === value || !(name in panel.facets)) &&
      on.every(([name, values]) => !(name in panel.facets) || values.has(panel.facets[name])));
  }

  addSwitches() {
    this.toggles.forEach(([name, values], i) => {
      const on = this.on(name, values);
      const act = (value) => (event) => {
        const next = new Set(on);
        if (event.shiftKey) {
          const alone = on.size === 1 && on.has(value);
          next.clear();
          (alone ? values : [value]).forEach((one) => next.add(one));
        } else if (!next.delete(value)) next.add(value);
        this.switchOn(name, values, next);
      };
      const lights = name === this.spec.lights;
      const made = values.map((value) => element("button", { type: "button", class: "key", "aria-pressed": String(on.has(value)), "data-lights": lights && value, on: { click: act(value) } }, value));
      const every = (text, wanted) => element("button", { type: "button", class: "every", on: { click: () => this.switchOn(name, values, new Set(wanted)) } }, text);
      if (values.length > 2) made.push(every("all", values), every("none", []));
      refill(this.switches[i], element("span", { class: "soft" }, `${name} `), ...made);
    });
  }

  scale(key, panel) {
    const axis = panel[AXES[key]];
    const value = state.get(this.key(key), axis.scale);
    return axis.scales.includes(value) && !axis.names.length ? value : axis.scale;
  }

  select(label, options, value, act) {
    const made = element("select", { on: { change: () => act(made.value) } }, ...options.map(([name, text]) => element("option", { value: name, selected: name === value }, text)));
    return element("label", {}, `${label} `, made);
  }

  addControls(panel) {
    const made = this.facets.map(([name, values]) => {
      const options = values.map((value) => [value, value]);
      if (name === this.spec.side_by_side) options.unshift([WHOLE, "all, side by side"]);
      const first = name === this.spec.side_by_side ? WHOLE : values[0];
      return this.select(name, options, this.chosen(name, values), (value) => {
        state.chosen.delete(this.key("zoom"));
        state.set(this.key(name), value, first);
      });
    });
    for (const key of ["y", "x"]) {
      const axis = panel[AXES[key]];
      if (axis.names.length || axis.scales.length < 2) continue;
      const options = axis.scales.map((scale) => [scale, NAMES[scale]]);
      made.push(this.select(key === "y" ? "vertical" : "horizontal", options, this.scale(key, panel), (value) => {
        state.chosen.delete(this.key("zoom"));
        state.set(this.key(key), value, axis.scale);
      }));
    }
    if (this.spec.panels.some(({ series }) => series.some(({ low }) => low))) {
      const on = state.get(this.key("intervals")) !== "off";
      made.push(element("button", { type: "button", class: "toggle", "aria-pressed": String(on), on: { click: () => state.set(this.key("intervals"), on ? "off" : "") } }, "intervals"));
    }
    const button = (text, label, act, off = false) => element("button", { type: "button", "aria-label": label, title: label, disabled: off, on: { click: act } }, text);
    made.push(
      element("span", { class: "zoom" },
        button("+", "zoom in", () => this.scaled(0.6)),
        button("−", "zoom out", () => this.scaled(1 / 0.6)),
        button("whole", "show everything again", () => this.reset(), !state.get(this.key("zoom")))),
    );
    refill(this.controls, ...made);
  }

  addLegend(panels) {
    const off = state.off();
    const series = new Map();
    for (const panel of panels) for (const one of panel.series) if (!series.has(one.name)) series.set(one.name, one);
    const names = [...series.keys()];
    const alone = (name) => {
      const others = names.filter((other) => other !== name);
      const already = !off.has(name) && others.every((other) => off.has(other));
      const next = new Set([...off].filter((other) => !names.includes(other)));
      if (!already) others.forEach((other) => next.add(other));
      state.switchOff(next);
    };
    const toggle = (name) => {
      const next = state.off();
      if (!next.delete(name)) next.add(name);
      state.switchOff(next);
    };
    const made = names.map((name) => {
      const { look, draw } = series.get(name);
      const act = (event) => (event.shiftKey || event.detail === 2 ? alone(name) : toggle(name));
      return element("button", { type: "button", class: "key", "aria-pressed": String(!off.has(name)), "data-name": name, on: { click: act } }, swatch(look, draw), ` ${name}`,
        this.spec.notes[name] ? element("span", { class: "soft" }, this.spec.notes[name]) : null);
    });
    if (names.length > 2) {
      made.push(element("button", { type: "button", class: "every", on: { click: () => state.switchOff([...off].filter((name) => !names.includes(name))) } }, "all"));
      made.push(element("button", { type: "button", class: "every", on: { click: () => state.switchOff(new Set([...off, ...names])) } }, "none"));
    }
    refill(this.legend, ...made);
  }

  // Ranges of both axes: zoomed, asked for, or of what is on in all panels that share the axis.
  ranges(panels, lines, panel, scales) {
    const zoom = state.get(this.key("zoom")).split(",");
    const part = this.spec.along && zoom[0] ? zoom.slice(0, 2).map(Number) : null;
    const sighted = (line, list) => (part && list ? list.filter((_, i) => line.xs[i] >= part[0] && line.xs[i] <= part[1]) : list);
    const range = (key, at, listsOf) => {
      if (zoom.length === 4 && zoom[at] !== "") return [Number(zoom[at]), Number(zoom[at + 1])];
      const axis = panel[AXES[key]];
      if (axis.names.length) return [-0.6, axis.names.length - 0.4];
      if (axis.ends && !(scales[key] === "log" && axis.ends[0] <= 0)) return axis.ends;
      const sharing = panels.map((other, i) => [other, lines[i]]).filter(([other]) => other[AXES[key]].label === axis.label);
      const lists = sharing.flatMap(([, own]) => own.flatMap(listsOf));
      if (key === "y" && sharing.some(([, own]) => own.some((line) => line.draw === "bars"))) lists.push([0]);
      lists.push(axis.holds);
      return roomy(scales[key], ...extent(lists, scales[key] === "log"));
    };
    return { x: range("x", 0, (line) => [line.xs]), y: range("y", 2, (line) => [line.ys, line.low, line.high].map((list) => sighted(line, list))) };
  }

  addChoices(panels) {
    this.addControls(panels[0] ?? this.spec.panels[0]);
    this.addSwitches();
    this.addLegend(panels);
  }

  draw() {
    this.old = false;
    this.views.forEach((view) => view.destroy());
    const panels = this.shown();
    const off = state.off();
    this.addChoices(panels);
    this.width = this.live.clientWidth;
    // Names of categories need more room than numbers.
    const need = Math.max(370, ...panels.map((panel) => 76 * panel.across.names.length + 80));
    const most = this.spec.columns ? (this.width < 560 ? 1 : this.spec.columns) : Math.floor(this.width / need);
    const across = Math.max(1, Math.min(panels.length, most));
    const width = Math.floor((this.width - 16 * (across - 1)) / across);
    const height = Math.max(260, Math.min(440, Math.round(width * 0.66)));
    const intervals = state.get(this.key("intervals")) !== "off";
    const lines = panels.map((panel) => linesOf(panel, intervals).filter((line) => !off.has(line.name)));
    const nothing = element("p", { class: "soft" }, "Everything is switched off.");
    this.panels.replaceChildren(...(panels.length ? [] : [nothing]));
    this.panels.style.gridTemplateColumns = `repeat(${across}, minmax(0, 1fr))`;
    this.views = panels.map((panel, i) => {
      const scales = { x: this.scale("x", panel), y: this.scale("y", panel) };
      const place = element("div", {
        class: "panel", tabindex: 0, role: "group", "data-lights": panel.facets[this.spec.lights] ?? false,
        "aria-label": `${panel.title}: ${panel.up.label} against ${panel.across.label}. Arrow keys read values, plus and minus zoom, 0 shows everything.`,
        on: { keydown: (event) => this.pressed(event, i) },
      });
      // Above the axis and not along it: it is read without turning the head, and is never cut.
      place.append(element("h4", {}, panel.title), element("p", { class: "up" }, panel.up.label));
      this.panels.append(place);
      return new PanelView(place, panel, lines[i], {
        width, height: panel.height || height, scales,
        along: this.spec.along,
        ranges: this.ranges(panels, lines, panel, scales),
        sync: this.spec.link || this.spec.name,
        acts: {
          zoomed: (x, y) => this.zoomed(x, y),
          reset: () => this.reset(),
          told: (text) => { this.told.textContent = text; },
        },
      });
    });
  }

  pressed(event, place) {
    const acts = { ArrowRight: () => this.views[place].step(1), ArrowLeft: () => this.views[place].step(-1), "+": () => this.scaled(0.6), "-": () => this.scaled(1 / 0.6), 0: () => this.reset() };
    if (!acts[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    acts[event.key]();
    // Drawn anew: the panel at this place goes on listening.
    this.panels.children[place]?.focus({ preventScroll: true });
  }

  zoomed(x, y) {
    const now = state.get(this.key("zoom"), ",,,").split(",");
    const text = (range, at) => (range ? range.map((v) => v.toPrecision(5)) : now.slice(at, at + 2));
    state.set(this.key("zoom"), [...text(x, 0), ...text(y, 2)].join(","));
    // Panels that are read together show the same stretch of time.
    if (this.spec.link && x) {
      for (const other of FIGURES) if (other !== this && other.spec.link === this.spec.link) state.set(other.key("zoom"), [...text(x, 0), "", ""].join(","));
    }
  }

  scaled(factor) {
    if (!this.views.length) return;
    const { u, scales, panel } = this.views[0];
    const stretch = (key) => {
      if (panel[AXES[key]].names.length) return null;
      const ends = [u.scales[key].min, u.scales[key].max].map((v) => forward(scales[key], v));
      const [middle, half] = [(ends[0] + ends[1]) / 2, ((ends[1] - ends[0]) / 2) * factor];
      return [backward(scales[key], middle - half), backward(scales[key], middle + half)];
    };
    this.zoomed(stretch("x"), this.spec.along ? null : stretch("y"));
  }

  reset() {
    state.set(this.key("zoom"), "");
    if (!this.spec.link) return;
    for (const other of FIGURES) if (other.spec.link === this.spec.link) state.set(other.key("zoom"), "");
  }

  resized() {
    if (this.live.clientWidth && this.live.clientWidth !== this.width) this.draw();
  }

  owns(key) {
    return key.startsWith(`${this.spec.name}.`);
  }

  concerns(key) {
    return key === "off" || key === "theme" || this.owns(key);
  }

  addFiles() {
    this.live.after(filesOf(this.place, this.spec.name, [...new Set(this.spec.panels.map((panel) => panel.table))]));
  }
}

// The one that was used keeps the focus although all are made anew.
function refill(place, ...made) {
  const usable = () => [...place.querySelectorAll("select, button")];
  const focused = usable().indexOf(document.activeElement);
  place.replaceChildren(...made);
  if (focused >= 0) usable()[focused]?.focus();
}

const FIGURES = [];
