// Below the table: accuracy against cost, and the error over frames of the first entries.

const COST_AXES = ["speed_up", "seconds_per_frame", "parameters"];
const LINES = 6;

/** Return the figures of a tab for the entries that the table shows. */
function drawFigures(tab, state, entries, act) {
  return [drawScatter(tab, state, entries, act), drawLines(tab, state, entries, act)];
}

function costAxes(tab) {
  return COST_AXES.filter((name) => tab.rows.some((row) => valueOf(tab, row, name) > 0));
}

function drawScatter(tab, state, entries, act) {
  const axes = costAxes(tab);
  const title = "Accuracy against cost";
  if (!axes.length) return figure(title, el("p", { class: "muted" }, "No entry says what it costs."), null, { name: "cost" });
  const by = axes.includes(state.cost) ? state.cost : axes[0];
  const points = entries
    .map((row) => ({ row, x: valueOf(tab, row, by), y: valueOf(tab, row, tab.ranking) }))
    .filter(({ x, y }) => x > 0 && Number.isFinite(y));
  const tools = axes.length > 1 ? chooser("against", axes.map((name) => [name, columnOf(tab, name).label]), by, act.cost) : null;
  const without = entries.length - points.length;
  const caption = [
    "Each dot is an entry; the line joins those that no other beats in both. ",
    by === "speed_up" ? "Speed-up is the time of the solver over that of the model, both on the same machine; below 1× the model is slower. " : "",
    "Costs are self-reported. ",
    without ? `${without} ${without === 1 ? "entry says" : "entries say"} nothing about ${columnOf(tab, by).label}.` : "",
  ].join("");
  const body = points.length ? scatter(tab, state, by, points) : el("p", { class: "muted" }, "No entry to show.");
  return figure(title, body, caption, { tools, name: "cost" });
}

function scatter(tab, state, by, points) {
  const levels = tab.floors.map((row) => [row.name, valueOf(tab, row, tab.ranking)]).filter(([, value]) => Number.isFinite(value));
  const reach = by === "speed_up" ? [1] : [];
  const x = scattered([...points.map((point) => point.x), ...reach]);
  const y = scattered([...points.map((point) => point.y), ...levels.map(([, value]) => value)]);
  const plot = new Plot(x, y, { xLabel: columnOf(tab, by).quantity, yLabel: columnOf(tab, tab.ranking).quantity, height: 310 });
  plot.linked = true;
  levels.forEach(([name, value], i) => plot.level(value, name, i % 2 === 1));
  if (by === "speed_up") plot.upright(1, "as fast as the solver");
  const front = paretoOf(tab, by, points.filter((point) => point.row.active));
  plot.marks.push(svg("path", { d: pathData(front.map((point) => [plot.column(point.x), plot.row(point.y)])), class: "front" }));
  const places = points.map((point) => ({ ...point, column: plot.column(point.x), row: plot.row(point.y), entry: point.row }));
  const labels = labelled(places, plot, levels.map(([, value]) => plot.row(value)));
  places.forEach((place, i) => plot.marks.push(dot(tab, state, by, place, front.some((one) => one.row === place.entry), labels[i])));
  return plot.draw("Accuracy against cost", `${points.length} entries by ${columnOf(tab, by).label} and ${columnOf(tab, tab.ranking).label}.`);
}

function dot(tab, state, by, place, best, label) {
  const name = short(place.entry.name);
  const told = [by, tab.ranking].map((key) => `${columnOf(tab, key).label} ${textOf(tab, place.entry, key)}`);
  const said = `${name}: ${told.join(", ")}`;
  return svg(
    "a",
    { href: addressOf({ ...state, entry: place.entry.id }), class: `dot ${best ? "best" : ""} ${place.entry.active ? "" : "inactive"}`.trim(), "aria-label": said },
    svg("title", {}, said),
    svg("circle", { cx: place.column.toFixed(1), cy: place.row.toFixed(1), r: 14, class: "reach" }),
    svg("circle", { cx: place.column.toFixed(1), cy: place.row.toFixed(1), r: 5 }),
    label ? svg("text", { x: label.x.toFixed(1), y: label.y.toFixed(1), class: `name${label.end ? " end" : ""}` }, label.text) : null,
  );
}

/** Return where names fit without touching dots or each other, best entries first. */
function labelled(places, plot, lines) {
  const taken = places.map(({ column, row }) => [column - 7, row - 7, column + 7, row + 7]);
  taken.push(...lines.map((row) => [0, row - 1, plot.across, row + 1]));
  return places.map(({ column, row, entry }) => {
    const text = short(entry.name, 22);
    const width = 7.4 * text.length;
    const tries = [[column + 9, row + 4, false], [column - 9, row + 4, true], [column + 4, row - 9, false], [column + 4, row + 17, false], [column - 4, row - 9, true]];
    for (const [x, y, end] of tries) {
      const box = end ? [x - width, y - 11, x, y + 3] : [x, y - 11, x + width, y + 3];
      const inside = box[0] >= 0 && box[2] <= plot.across && box[1] >= 0 && box[3] <= plot.up;
      const own = (other) => column >= other[0] && column <= other[2] && row >= other[1] && row <= other[3];
      if (inside && !taken.some((other) => !own(other) && meets(box, other))) {
        taken.push(box);
        return { x, y, end, text };
      }
    }
    return null;
  });
}

function meets([left, top, right, bottom], other) {
  return left < other[2] && right > other[0] && top < other[3] && bottom > other[1];
}

/** Return the points that no other beats in both, from cheap to dear. */
function paretoOf(tab, by, points) {
  const cost = (point) => (by === "speed_up" ? -point.x : point.x);
  const loss = (point) => lossOf(tab, tab.ranking, point.y);
  const sorted = [...points].sort((a, b) => cost(a) - cost(b) || loss(a) - loss(b));
  let best = Infinity;
  return sorted.filter((point) => loss(point) < best && ((best = loss(point)), true));
}

function drawLines(tab, state, entries, act) {
  const options = tab.curves.map(({ key: name, label }) => [name, label]);
  const by = tab.curves.some((curve) => curve.key === state.curve) ? state.curve : tab.curves[0].key;
  const chosen = entries.filter((row) => row.curves[by]).slice(0, LINES);
  const lines = [...chosen.map((row, i) => [`s${i}`, row]), ...floorsOf(tab).filter(([, row]) => row.curves[by])];
  const body = lines.length ? [key(lines.map(([kind, row]) => [kind, short(row.name)])), lineChart(tab, by, lines)] : el("p", { class: "muted" }, "No entry to show.");
  const more = entries.length > LINES ? `The first ${LINES} entries of the table as it is sorted. ` : "";
  return figure("Error over frames", body, `${more}Mean over test scenarios; grey: floors that cost nothing.`, {
    tools: options.length > 1 ? chooser("of", options, by, act.curve) : null,
    name: "lines",
  });
}

/** Return curves of rows; those listed in `banded` with the range of their scenarios. */
function lineChart(tab, by, lines, banded = []) {
  const curves = lines.map(([kind, row]) => ({ kind, row, ...curveOf(row.curves[by]) }));
  const shown = curves.flatMap(({ row, mean, high }) => [...mean, ...(banded.includes(row) ? high : [])]);
  const plot = new Plot(frameAxis(tab), curveAxis(tab, by, shown), { xLabel: "frame", yLabel: columnOf(tab, by).quantity });
  curves.filter(({ row }) => banded.includes(row)).forEach(({ frames, low, high, kind }) => plot.band(frames, low, high, kind));
  [...curves].reverse().forEach(({ frames, mean, kind, row }) => plot.line(frames, mean, kind, short(row.name)));
  plot.series.reverse();
  if (by === "vorticity_pearson") plot.level(0.8, "stable above 0.8");
  return plot.draw(`${columnOf(tab, by).label} over frames`, `One line each for ${lines.map(([, row]) => short(row.name)).join(", ")}.`);
}

function curveAxis(tab, by, values) {
  if (columnOf(tab, by).direction === "higher") return linear(Math.min(0, ...values.filter(Number.isFinite)), 1);
  return spanning(values);
}

function frameAxis(tab, count = 6) {
  return linear(tab.frames[0], tab.frames[1], { count, tight: true });
}
