// Charts as SVG: axes with few quiet lines; classes of marks are those of the report.

const EDGE = { left: 48, right: 12, top: 30, bottom: 40 };
const FAR = 3;

function pathData(points) {
  let data = "";
  let down = false;
  for (const [x, y] of points) {
    const known = Number.isFinite(x) && Number.isFinite(y);
    if (known) data += `${down ? "L" : "M"}${+x.toFixed(1)} ${+y.toFixed(1)}`;
    down = known;
  }
  return data;
}

/** One chart, built mark by mark. */
class Plot {
  constructor(x, y, { xLabel, yLabel, width = 460, height = 270 }) {
    Object.assign(this, { x, y, xLabel, yLabel, width, height });
    this.across = width - EDGE.left - EDGE.right;
    this.up = height - EDGE.top - EDGE.bottom;
    this.marks = [];
    this.series = [];
  }

  column(value) {
    return clamp(this.x.share(value), -FAR, FAR) * this.across;
  }

  row(value) {
    return (1 - clamp(this.y.share(value), -FAR, FAR)) * this.up;
  }

  line(xs, ys, kind, name = "") {
    const points = Array.from(xs, (x, i) => [this.column(x), this.row(ys[i])]);
    this.marks.push(svg("path", { d: pathData(points), class: `line ${kind}` }, name ? svg("title", {}, name) : null));
    if (name) this.series.push({ xs, ys, name });
  }

  band(xs, lows, highs, kind) {
    const known = Array.from(xs, (x, i) => i).filter((i) => Number.isFinite(lows[i]) && Number.isFinite(highs[i]));
    const there = known.map((i) => [this.column(xs[i]), this.row(highs[i])]);
    const back = known.map((i) => [this.column(xs[i]), this.row(Math.max(lows[i], this.y.low))]).reverse();
    if (known.length) this.marks.push(svg("path", { d: `${pathData([...there, ...back])}Z`, class: `band ${kind}` }));
  }

  steps(low, high, shares, kind, name) {
    const width = (high - low) / shares.length;
    const xs = Array.from({ length: 2 * shares.length }, (_, i) => low + width * Math.ceil(i / 2));
    this.line(xs, Array.from(xs, (_, i) => shares[Math.floor(i / 2)]), `steps ${kind}`, name);
    this.series.pop();
  }

  level(value, label, left = false) {
    const row = this.row(value);
    if (row < 0 || row > this.up) return;
    this.marks.push(svg("path", { d: `M0 ${row.toFixed(1)}H${this.across}`, class: "level" }));
    this.marks.push(svg("text", { x: left ? 4 : this.across, y: (row - 5).toFixed(1), class: left ? "note" : "note end" }, label));
  }

  axes() {
    const bottom = EDGE.top + this.up;
    const right = this.width - EDGE.right;
    const drawn = [];
    for (const tick of this.y.ticks) {
      const row = (EDGE.top + this.row(tick.value)).toFixed(1);
      drawn.push(svg("path", { d: `M${EDGE.left} ${row}H${right}`, class: "grid" }));
      drawn.push(svg("text", { x: EDGE.left - 7, y: +row + 4, class: "tick end" }, tick.label));
    }
    for (const tick of this.x.ticks) {
      const column = (EDGE.left + this.column(tick.value)).toFixed(1);
      drawn.push(svg("path", { d: `M${column} ${bottom}v4`, class: "mark" }));
      drawn.push(svg("text", { x: column, y: bottom + 17, class: "tick middle" }, tick.label));
    }
    drawn.push(svg("path", { d: `M${EDGE.left} ${bottom}H${right}`, class: "axis" }));
    drawn.push(svg("text", { x: right, y: this.height - 5, class: "label end" }, withFactor(this.xLabel, this.x)));
    drawn.push(svg("text", { x: 2, y: 14, class: "label" }, withFactor(this.yLabel, this.y)));
    return drawn;
  }

  draw(title, description) {
    const area = svg("svg", { x: EDGE.left - 3, y: EDGE.top - 3, width: this.across + 6, height: this.up + 6 });
    area.append(svg("g", { transform: "translate(3 3)" }, this.marks));
    const whole = svg(
      "svg",
      { viewBox: `0 0 ${this.width} ${this.height}`, class: "chart", role: "img", "aria-label": title },
      svg("desc", {}, description),
      this.axes(),
      area,
    );
    return this.series.length ? withReadout(this, whole, area) : whole;
  }
}

function withFactor(label, scale) {
  return scale.factor ? [label, svg("tspan", { class: "factor" }, `  ${scale.factor}`)] : label;
}

function clamp(value, low, high) {
  return Number.isNaN(value) ? NaN : Math.min(high, Math.max(low, value));
}

/** Return the chart with a line of numbers that follows the pointer. */
function withReadout(plot, whole, area) {
  const line = svg("path", { class: "hair" });
  const said = el("p", { class: "readout", "aria-hidden": "true" });
  area.append(line);
  whole.addEventListener("pointermove", (event) => {
    const box = whole.getBoundingClientRect();
    const share = ((event.clientX - box.left) * (plot.width / box.width) - EDGE.left) / plot.across;
    if (share < -0.02 || share > 1.02) return;
    const at = plot.x.low + share * (plot.x.high - plot.x.low);
    const frame = nearestOf(plot.series[0].xs, at);
    line.setAttribute("d", `M${(plot.column(frame) + 3).toFixed(1)} 3v${plot.up}`);
    const told = plot.series.map(({ xs, ys, name }) => {
      const value = ys[Array.from(xs).indexOf(frame)];
      return el("span", {}, `${name} ${written(value ?? NaN)}`);
    });
    said.replaceChildren(el("strong", {}, `${plot.xLabel} ${frame}`), ...told);
  });
  whole.addEventListener("pointerleave", () => {
    line.removeAttribute("d");
    said.replaceChildren();
  });
  return el("div", { class: "plot" }, whole, said);
}

function nearestOf(values, wanted) {
  return values.reduce((best, value) => (Math.abs(value - wanted) < Math.abs(best - wanted) ? value : best));
}

/** Return what the marks of a chart mean; items are [classes, name]. */
function key(items, mark = (kind) => svg("path", { d: "M1 5H21", class: `line ${kind}` })) {
  const swatch = (kind) => svg("svg", { viewBox: "0 0 22 10", class: "swatch", "aria-hidden": "true" }, mark(kind));
  return el("ul", { class: "key" }, items.map(([kind, name]) => el("li", {}, swatch(kind), el("span", {}, name))));
}
