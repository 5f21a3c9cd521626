// Scales: where ticks stand, and how far an axis goes.

const SCALES = {
  linear: { distr: 1 },
  log: { distr: 3, log: 10 },
  // Linear from 0 to 1, logarithmic beyond, as in the printed figures.
  symlog: {
    distr: 100,
    fwd: (v) => (v < 0 ? -SCALES.symlog.fwd(-v) : v < 1 ? v / 2 : 0.5 + Math.log10(v)),
    bwd: (v) => (v < 0 ? -SCALES.symlog.bwd(-v) : v < 0.5 ? 2 * v : 10 ** (v - 0.5)),
  },
};

function forward(scale, value) {
  return scale === "log" ? Math.log10(value) : scale === "symlog" ? SCALES.symlog.fwd(value) : value;
}

function backward(scale, value) {
  return scale === "log" ? 10 ** value : scale === "symlog" ? SCALES.symlog.bwd(value) : value;
}

function evenly(low, high, most) {
  const raw = (high - low) / Math.max(most, 1);
  const size = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((n) => n * size).find((n) => n >= raw * 0.999);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i += 1) found.push(Number((i * step).toPrecision(12)));
  return found;
}

function decades(low, high, most) {
  const first = Math.floor(Math.log10(low)), last = Math.ceil(Math.log10(high));
  const within = (v) => v >= low * 0.999 && v <= high * 1.001;
  const skip = Math.ceil((last - first) / Math.max(most, 1));
  const found = [];
  for (let e = Math.ceil(first / skip) * skip; e <= last; e += skip) if (within(10 ** e)) found.push(10 ** e);
  if (found.length >= 3 || skip > 1) return found;
  const finer = [];
  for (let e = first; e <= last; e += 1) for (const n of [1, 2, 5]) if (within(n * 10 ** e)) finer.push(Number(`${n}e${e}`));
  return finer.length >= 3 ? finer : evenly(low, high, most).filter((v) => v > 0);
}

// Ticks of an axis so long in pixels: those asked for, thinned, where enough of them are in sight.
function ticks(axis, scale, low, high, length, room) {
  const most = Math.max(2, Math.floor(length / room));
  if (axis.names.length) return axis.names.map((_, place) => place).filter((v) => v >= low && v <= high);
  const asked = axis.ticks.filter((v) => v >= low && v <= high);
  if (asked.length >= 3 && scale !== "linear") {
    const place = (v) => ((forward(scale, v) - forward(scale, low)) / (forward(scale, high) - forward(scale, low))) * length;
    const kept = [asked[asked.length - 1]];
    for (const v of asked.slice(0, -1).reverse()) if (place(kept[0]) - place(v) >= room * 0.6) kept.unshift(v);
    return kept;
  }
  if (scale === "linear") return evenly(low, high, most);
  if (low > 0) return decades(low, high, most);
  return evenly(low, high, most);
}

function tickText(axis, value) {
  if (axis.names.length) return axis.names[value] ?? "";
  const exponent = Math.round(Math.log10(Math.abs(value)));
  const power = value > 0 && Math.abs(Math.log10(value) - exponent) < 1e-9;
  if (power && (exponent < -2 || exponent > 4)) return `10${raised(exponent)}`;
  return readable(value, 4);
}

// The range of values, with a little room at both ends.
function roomy(scale, low, high) {
  if (!(low <= high)) return scale === "log" ? [0.1, 10] : [0, 1];
  const ends = [forward(scale, low), forward(scale, high)];
  const pad = 0.04 * (ends[1] - ends[0]) || (scale === "log" ? 0.3 : Math.abs(ends[0]) * 0.1 || 1);
  return [backward(scale, ends[0] - pad), backward(scale, ends[1] + pad)];
}
