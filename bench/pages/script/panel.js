// One pair of axes on the screen.

// Series of a panel with their numbers; those on a logarithmic axis without what it cannot hold.
function linesOf(panel, intervals) {
  const held = table(panel.table);
  const xs = held.values(panel.x);
  return panel.series.map((series) => {
    const rows = held.where(series.where);
    const pick = (name) => name && ((values) => rows.map((row) => values[row]))(held.values(name));
    return {
      ...series,
      xs: rows.map((row) => xs[row]),
      ys: pick(series.y),
      low: intervals && pick(series.low),
      high: intervals && pick(series.high),
      marks: panel.across.ticks,
    };
  });
}

// Smallest and largest value among lines that an axis must hold.
function extent(lists, positive) {
  let low = Infinity, high = -Infinity;
  for (const list of lists) {
    for (const value of list || []) {
      if (!Number.isFinite(value) || (positive && value <= 0)) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  return [low, high];
}

// Columns as the library wants them: one x for all, undefined where a series has no such x, null
// where it has no number there.
function aligned(lines, log) {
  const number = (value) => (Number.isFinite(value) && !(log && value <= 0) ? value : null);
  const first = lines[0]?.xs ?? [];
  const sameX = lines.every(({ xs }) => xs.length === first.length && xs.every((x, i) => x === first[i]));
  const sorted = first.every((x, i) => !i || first[i - 1] <= x);
  if (sameX && sorted) return [first, ...lines.map(({ ys }) => ys.map(number))];
  const all = [...new Set(lines.flatMap(({ xs }) => xs))].sort((a, b) => a - b);
  const place = new Map(all.map((x, i) => [x, i]));
  const columns = lines.map(({ xs, ys }) => {
    const column = new Array(all.length).fill(undefined);
    xs.forEach((x, i) => (column[place.get(x)] = number(ys[i])));
    return column;
  });
  return [all, ...columns];
}

// Width of a vertical axis: its longest number has room, as -1.25×10⁻⁶; most axes are alike.
function roomBeside(u, texts, number) {
  const { ticks, gap, font } = u.axes[number];
  u.ctx.font = font[0];
  const widths = (texts || []).map((text) => u.ctx.measureText(text || "").width / devicePixelRatio);
  return Math.max(58, Math.ceil(ticks.size + gap + Math.max(0, ...widths)));
}

class PanelView {
  // `scales` and `ranges` by "x" and "y"; `acts`: zoomed([x0, x1, y0, y1]), reset(), told(text).
  constructor(place, panel, lines, { width, height, scales, ranges, sync, along, acts }) {
    this.panel = panel;
    this.along = along;
    this.lines = lines;
    this.acts = acts;
    this.scales = scales;
    this.tip = element("div", { class: "tip", hidden: true });
    const axis = (key, described, room) => ({
      stroke: ink("ink"),
      grid: { stroke: ink("line"), width: 1 },
      ticks: { stroke: ink("line"), width: 1, size: 5 },
      font: `${described.names.length && width < 500 ? 10 : 12}px system-ui, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif`,
      labelFont: '13px system-ui, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif',
      label: key === "x" ? described.label : undefined,
      labelSize: 22,
      filter: (_, splits) => splits,
      splits: (u, _, low, high) => ticks(described, scales[key], low, high, (key === "x" ? u.bbox.width : u.bbox.height) / devicePixelRatio, room),
      values: (_, splits) => splits.map((value) => tickText(described, value)),
    });
    const fixed = (key) => () => ranges[key];
    this.u = new uPlot(
      {
        width,
        height,
        legend: { show: false },
        scales: {
          x: { time: false, ...SCALES[scales.x], range: fixed("x") },
          y: { ...SCALES[scales.y], range: fixed("y") },
        },
        axes: [
          { ...axis("x", panel.across, 56), size: panel.across.names.length ? 46 : 34 },
          { ...axis("y", panel.up, height < 220 ? 18 : 30), size: roomBeside },
        ],
        series: [{}, ...lines.map((line) => this.drawn(line))],
        cursor: {
          // Cursors move together; whoever zooms tells the others by the page's state.
          sync: { key: sync, scales: ["x", null], filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } },
          drag: { x: true, y: !along, uni: 24, setScale: false },
          points: { size: 7 },
          bind: { dblclick: () => () => acts.reset() },
        },
        hooks: {
          drawClear: [(u) => { drawSpans(u, panel.spans); lines.forEach((line) => drawBand(u, line, lines.length)); lines.filter((line) => line.under).forEach((line) => drawMarks(u, line)); }],
          draw: [(u) => this.over(u)],
          setSelect: [(u) => this.selected(u)],
          setCursor: [(u) => this.show(u)],
        },
      },
      aligned(lines, scales.y === "log"),
      place,
    );
    this.u.over.append(this.tip);
    this.u.over.addEventListener("mouseleave", () => { this.tip.hidden = true; });
  }

  drawn(line) {
    const { colour, dashes } = styled(line.look);
    const own = line.draw === "points" || line.draw === "bars";
    return {
      label: line.name,
      stroke: colour,
      width: 2,
      dash: dashes.map((d) => 2 * d),
      points: { show: false },
      paths: own ? () => null : line.draw === "steps" ? uPlot.paths.stepped({ align: 1 }) : uPlot.paths.linear(),
    };
  }

  over(u) {
    const bars = this.lines.filter((line) => line.draw === "bars");
    bars.forEach((line) => drawBars(u, line, bars.length));
    drawRules(u, this.panel.rules);
    this.lines.filter((line) => !line.under).forEach((line) => drawMarks(u, line));
  }

  selected(u) {
    const { left, top, width, height } = u.select;
    if (width < 4 && (height < 4 || this.along)) return;
    const x = width < 4 ? null : [u.posToVal(left, "x"), u.posToVal(left + width, "x")];
    const y = height < 4 || this.along ? null : [u.posToVal(top + height, "y"), u.posToVal(top, "y")];
    // Later: the library must have let go of the mouse before its panel is drawn anew.
    setTimeout(() => this.acts.zoomed(x, y));
  }

  // What each series is where the cursor is, the largest first.
  at(index) {
    const x = this.u.data[0][index];
    const found = [];
    this.lines.forEach((line, i) => {
      const value = this.u.data[i + 1][index];
      if (value === null || value === undefined) return;
      const row = line.xs.indexOf(x);
      const interval = line.low && Number.isFinite(line.low[row]) ? [line.low[row], line.high[row]] : null;
      found.push({ line, value, interval });
    });
    found.sort((a, b) => b.value - a.value);
    return { x, found };
  }

  // What is said there: look, how it is drawn, name, value with its unit, in brackets what else.
  said(x, found) {
    if (!this.panel.tells.length) {
      return found.map(({ line, value, interval }) => [line.look, line.draw, line.name, readable(value), interval ? ` (${between(...interval)})` : ""]);
    }
    const held = table(this.panel.table);
    const xs = held.values(this.panel.x);
    const row = held.where(this.panel.series[0].where).find((place) => xs[place] === x);
    const withUnit = (value, unit) => `${readable(value)}${unit && ` ${unit}`}`;
    return this.panel.tells.map(({ look, says, y, unit, times, also }) => {
      const value = row === undefined ? NaN : held.values(y)[row];
      return [look, look && !look[2].length && look[3] ? "points" : "line", says, withUnit(value, unit), times ? ` (${withUnit(value * times, also)})` : ""];
    });
  }

  head(x) {
    const { names, label } = this.panel.across;
    return names.length ? names[x].replace("\n", ", ") : `${label}: ${readable(x, 5)}`;
  }

  show(u) {
    const { idx, left, top, event } = u.cursor;
    // Charts that move along show their cursor alone.
    if (idx === null || left < 0 || !event || !u.over.contains(event.target)) {
      this.tip.hidden = true;
      return;
    }
    const { x, found } = this.at(idx);
    this.tip.replaceChildren(
      element("strong", {}, this.head(x)),
      ...this.said(x, found).map(([look, draw, name, value, more]) => element("div", {}, look && swatch(look, draw), ` ${name} `, element("b", {}, value), more)),
    );
    this.tip.hidden = !found.length;
    const { offsetWidth: wide, offsetHeight: tall } = this.tip;
    const { clientWidth, clientHeight } = u.over;
    this.tip.style.left = `${left + wide + 24 > clientWidth ? Math.max(left - wide - 14, -50) : left + 14}px`;
    this.tip.style.top = `${Math.max(-30, Math.min(top - tall / 2, clientHeight - tall + 30))}px`;
  }

  // The keyboard's cursor: tells what stands there.
  step(by) {
    const { u } = this;
    const [low, high] = [u.scales.x.min, u.scales.x.max];
    const there = u.data[0].map((x, i) => [x, i]).filter(([x]) => x >= low && x <= high).map(([, i]) => i);
    if (!there.length) return;
    const now = there.indexOf(u.cursor.idx ?? -1);
    const next = there[Math.max(0, Math.min(there.length - 1, now < 0 ? (by > 0 ? 0 : there.length - 1) : now + by))];
    const { x, found } = this.at(next);
    u.setCursor({ left: u.valToPos(x, "x"), top: found.length ? u.valToPos(found[0].value, "y") : 0 });
    const told = this.said(x, found).map(([, , name, value, more]) => `${name} ${value}${more}`);
    this.acts.told(`${this.panel.title}. ${this.head(x)}. ${told.join("; ")}`);
  }

  destroy() {
    this.u.destroy();
  }
}
