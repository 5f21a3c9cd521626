// What the charting library does not draw: intervals, markers, error bars, bars, rules, spans.

const MARKED = 400; // more points than this have no markers

function clipped(u, act) {
  const { left, top, width, height } = u.bbox;
  u.ctx.save();
  u.ctx.beginPath();
  u.ctx.rect(left, top, width, height);
  u.ctx.clip();
  act(u.ctx, u.bbox);
  u.ctx.restore();
}

function spot(u, x, y) {
  return [u.valToPos(x, "x", true), u.valToPos(y, "y", true)];
}

function drawSpans(u, spans) {
  clipped(u, (ctx, box) => {
    for (const span of spans) {
      if (span.along === "y") {
        const [top, foot] = [span.high, span.low].map((value) => u.valToPos(value, "y", true));
        ctx.fillStyle = span.look ? styled(span.look).colour : ink("shade");
        ctx.fillRect(box.left, top, box.width, foot - top);
        continue;
      }
      const from = Math.max(u.valToPos(span.low, "x", true), box.left);
      const to = Math.min(u.valToPos(span.high, "x", true), box.left + box.width);
      if (to <= from) continue;
      ctx.fillStyle = span.look ? styled(span.look).colour : ink("shade");
      const tall = span.foot ? 9 * devicePixelRatio : box.height;
      ctx.fillRect(from, box.top + box.height - tall, to - from, tall);
      if (!span.foot || !span.says) continue;
      ctx.fillStyle = ink("ink");
      ctx.font = font(11);
      ctx.textAlign = "center";
      if (ctx.measureText(span.says).width < to - from - 6) ctx.fillText(span.says, (from + to) / 2, box.top + box.height - tall - 5 * devicePixelRatio);
    }
  });
}

function drawRules(u, rules) {
  clipped(u, (ctx, box) => {
    ctx.strokeStyle = ctx.fillStyle = ink("soft");
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
    ctx.font = font(11);
    ctx.textAlign = "left";
    for (const rule of rules) {
      const at = Math.round(u.valToPos(rule.value, rule.along, true));
      ctx.beginPath();
      if (rule.along === "y") ctx.moveTo(box.left, at), ctx.lineTo(box.left + box.width, at);
      else ctx.moveTo(at, box.top), ctx.lineTo(at, box.top + box.height);
      ctx.stroke();
      if (rule.along === "y") ctx.fillText(rule.says, box.left + 6 * devicePixelRatio, at - 5 * devicePixelRatio);
      else ctx.fillText(rule.says, at + 5 * devicePixelRatio, box.top + 14 * devicePixelRatio);
    }
  });
}

function drawBand(u, line, count) {
  if (!line.low || line.draw === "points" || line.draw === "bars") return;
  clipped(u, (ctx) => {
    ctx.fillStyle = faint(styled(line.look).colour, (dark() ? 0.2 : 0.14) * (count > 4 ? 0.6 : 1));
    ctx.beginPath();
    let begun = false;
    const there = line.xs.map((_, i) => i).filter((i) => Number.isFinite(line.low[i]) && Number.isFinite(line.high[i]));
    for (const i of there) {
      const [x, y] = spot(u, line.xs[i], line.high[i]);
      if (begun) ctx.lineTo(x, y);
      else ctx.moveTo(x, y), (begun = true);
    }
    for (const i of there.reverse()) ctx.lineTo(...spot(u, line.xs[i], line.low[i]));
    ctx.fill();
  });
}

function drawBars(u, line, count) {
  clipped(u, (ctx, box) => {
    const wide = Math.max(2, Math.abs(u.valToPos(1, "x", true) - u.valToPos(0, "x", true)) * Math.min(0.8, 0.8 / count));
    ctx.fillStyle = styled(line.look).colour;
    line.xs.forEach((x, i) => {
      if (!Number.isFinite(line.ys[i])) return;
      const [across, up] = spot(u, x + line.shift, line.ys[i]);
      const zero = u.scales.y.distr === 3 ? box.top + box.height : u.valToPos(0, "y", true);
      ctx.fillRect(across - wide / 2, Math.min(up, zero), wide, Math.abs(zero - up));
    });
  });
}

function drawMarks(u, line) {
  const points = line.draw === "points";
  if (!points && (line.draw === "bars" || line.xs.length > MARKED)) return;
  const { colour, marker } = styled(line.look);
  if (!marker && !points) return;
  // Beneath lines many small ones are ground; upon them each is read.
  const size = (line.xs.length > MARKED ? 2 : line.under && line.xs.length > 100 ? 2.6 : 4) * devicePixelRatio;
  const wanted = points ? null : new Set(line.marks);
  // Along a smooth curve a few are enough to tell it from the others.
  const every = wanted && !wanted.size && line.xs.length > 16 ? Math.ceil(line.xs.length / 8) : 1;
  clipped(u, (ctx) => {
    ctx.fillStyle = ctx.strokeStyle = colour;
    ctx.lineWidth = 1.2 * devicePixelRatio;
    line.xs.forEach((value, i) => {
      if (i % every || !Number.isFinite(line.ys[i]) || (wanted && wanted.size && !wanted.has(value))) return;
      const [x, y] = spot(u, value + line.shift, line.ys[i]);
      ctx.fill(markerPath(marker || "o", x, y, size));
      if (!points || !line.low || !Number.isFinite(line.low[i])) return;
      ctx.beginPath();
      ctx.moveTo(x, u.valToPos(line.low[i], "y", true));
      ctx.lineTo(x, u.valToPos(line.high[i], "y", true));
      ctx.stroke();
    });
  });
}

function font(size) {
  return `${size * devicePixelRatio}px system-ui, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif`;
}
