// Below the table: the error over frames of the first entries. Accuracy against cost is drawn in lagbench/board/cost.py.

const LINES = 6;

function drawLines(tab, state, entries, act) {
  const options = tab.curves.map(({ key: name, label }) => [name, label]);
  const by = tab.curves.some((curve) => curve.key === state.curve) ? state.curve : tab.curves[0].key;
  const chosen = entries.filter((row) => row.curves[by]).slice(0, LINES);
  const lines = [...chosen.map((row, i) => [`s${i}`, row]), ...referencesOf(tab).filter(([, row]) => row.curves[by])];
  const body = lines.length ? [key(lines.map(([kind, row]) => [kind, short(row.name)])), lineChart(tab, by, lines)] : el("p", { class: "muted" }, "No entry to show.");
  const more = entries.length > LINES ? `The first ${LINES} entries of the table as it is sorted. ` : "";
  return figure("Error over frames", body, `${more}Mean over test scenarios; grey: reference predictors.`, {
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
  if (by === "vorticity_pearson") plot.level(0.95, "stable above 0.95");
  return plot.draw(`${columnOf(tab, by).label} over frames`, `One line each for ${lines.map(([, row]) => short(row.name)).join(", ")}.`);
}

function curveAxis(tab, by, values) {
  if (columnOf(tab, by).direction === "higher") return linear(Math.min(0, ...values.filter(Number.isFinite)), 1);
  return spanning(values);
}

function frameAxis(tab, count = 6) {
  return linear(tab.frames[0], tab.frames[1], { count, tight: true });
}
