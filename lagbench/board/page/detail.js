// What opens for an entry: how it fares, frame by frame and scenario by scenario.

/** Return the content of the panel and its film. */
function drawDetail(tab, state, row) {
  const [filmFigure, film] = drawFilm(tab, row);
  const content = [
    drawTiles(tab, row),
    drawFlags(row),
    el("div", { class: "figures" }, [drawErrors(tab, row), drawScenarios(tab, row), drawMaps(tab, row), filmFigure, drawEnergy(tab, row), drawHistograms(tab, row)]),
    drawFrames(tab, row),
    drawNumbers(tab, row),
    drawOrigin(tab, row),
  ];
  return [content, film];
}

function floorsOf(tab, row) {
  return tab.rows.filter((one) => one.floor && one !== row).map((one, i) => [`floor${i}`, one]);
}

function leaderOf(tab) {
  return tab.rows.find((row) => !row.floor && row.rank !== null && isActive(row));
}

function drawTiles(tab, row) {
  const tile = (what, big, more) => el("li", {}, el("span", { class: "what" }, what), el("span", { class: "big" }, big), el("span", { class: "more" }, more));
  const tiles = tab.presets.main.slice(0, 4).filter((name) => tab.metrics.includes(name)).map((name) => {
    const [, low, high, std] = row.values[tab.metrics.indexOf(name)] ?? [];
    const interval = low === null || low === undefined ? "" : `${written(number(low))} … ${written(number(high))}`;
    const seeds = std ? `, ± ${written(std)} over ${row.seeds} seeds` : "";
    return tile(withUnit(name), cellText(valueOf(tab, row, name), "number"), interval + seeds);
  });
  if (row.cost?.speed_up) tiles.push(tile("speed, solver = 1×; self-reported", cellText(row.cost.speed_up, "factor"), `${row.cost.speed_up < 1 ? "slower" : "faster"} than the solver, ${row.cost.device}`));
  else if (row.cost) tiles.push(tile("time per frame [s], self-reported", written(row.cost.seconds_per_frame), row.cost.device));
  if (row.parameters) tiles.push(tile("parameters, self-reported", cellText(row.parameters, "count"), row.hardware));
  return el("ul", { class: "tiles" }, tiles);
}

function drawFlags(row) {
  const items = [
    ...row.flags.map(([name, reasons]) => ["bad", "flag", labelOf(name), flagText(name, reasons)]),
    ...row.warnings.map(([name, reasons]) => ["warn", "warning", labelOf(name), flagText(name, reasons)]),
  ];
  if (row.diverged) items.push(["warn", "warning", "diverged", `${row.diverged} rollouts are frozen at their last finite frame.`]);
  if (row.status !== "active") {
    const by = row.by ? ` Replaced by ${row.by}.` : "";
    items.push(["unknown", "status", row.status, `${row.reason}${by}`]);
  }
  if (!row.current) items.push(["unknown", "status", `data ${row.version}`, "Scored on a data set version that is no longer current: not ranked."]);
  const said = items.map(([kind, sort, name, text]) => el("li", {}, el("span", { class: `flag ${kind}` }, sort), el("span", {}, el("strong", {}, name), text ? `: ${text}` : "")));
  return said.length ? el("ul", { class: "flags" }, said) : null;
}

function drawErrors(tab, row) {
  const leader = leaderOf(tab);
  const rows = [["s0", row], ...(leader && leader !== row ? [["s1", leader]] : []), ...floorsOf(tab, row)];
  const options = tab.curves.filter(({ key: name }) => row.curves[name]).map(({ key: name, label }) => [name, label]);
  const holder = el("div");
  const show = (by) => {
    const lines = rows.filter(([, one]) => one.curves[by]);
    holder.replaceChildren(key(lines.map(([kind, one]) => [kind, short(one.name)])), lineChart(tab, by, lines, [row]));
  };
  if (options.length) show(options[0][0]);
  return figure("Error over frames", holder, "Mean over test scenarios and seeds; the band reaches from the lowest to the highest scenario.", {
    tools: options.length > 1 ? chooser("of", options, options[0][0], show) : null,
    name: "errors",
  });
}

function drawScenarios(tab, row) {
  const options = Object.keys(row.spread).map((name) => [name, columnOf(name).label]);
  const rows = [["s0", row], ...floorsOf(tab, row)];
  const holder = el("div");
  const show = (by) => holder.replaceChildren(key(rows.map(([kind, one]) => [kind, short(one.name)]), spot), scenarioChart(tab, by, rows));
  if (options.length) show(options[0][0]);
  return figure("Every test scenario", holder, "Means over the horizon. Hollow: floors that cost nothing.", {
    tools: options.length > 1 ? chooser("of", options, options[0][0], show) : null,
    name: "scenarios",
  });
}

function scenarioChart(tab, by, rows) {
  const held = rows.map(([kind, row]) => [kind, short(row.name), (row.spread[by] ?? []).map(number)]);
  const count = tab.scenarios.length;
  const places = { low: -0.5, high: count - 0.5, share: (value) => (value + 0.5) / count, factor: "", ticks: tab.scenarios.map((id, i) => ({ value: i, label: String(id) })) };
  const plot = new Plot(places, spanning(held.flatMap(([, , values]) => values)), { xLabel: "scenario", yLabel: withUnit(by) });
  [...held].reverse().forEach(([kind, name, values]) => values.forEach((value, i) => {
    if (!Number.isFinite(value)) return;
    const mark = spot(kind, plot.column(i), plot.row(value));
    mark.append(svg("title", {}, `${name}, scenario ${tab.scenarios[i]}: ${written(value)}`));
    plot.marks.push(mark);
  }));
  return plot.draw(`${columnOf(by).label} of every test scenario`, held.map(([, name, values]) => `${name}: ${values.map((v) => written(v)).join(", ")}`).join(". "));
}

/** Return a mark: a dot for an entry, hollow ones of two shapes for the floors. */
function spot(kind, x = 11, y = 5) {
  if (kind === "floor1") return svg("path", { d: `M${(x - 4).toFixed(1)} ${y.toFixed(1)}l4 -4l4 4l-4 4Z`, class: `spot ${kind}` });
  return svg("circle", { cx: x.toFixed(1), cy: y.toFixed(1), r: kind === "s0" ? 5 : 3.8, class: `spot ${kind}` });
}

function drawEnergy(tab, row) {
  const truth = curveOf(tab.energy);
  const rows = [["s0", row], ...floorsOf(tab, row)].filter(([, one]) => one.energy);
  const lines = rows.map(([kind, one]) => ({ kind, name: short(one.name), ...curveOf(one.energy) }));
  const roof = 3 * Math.max(...truth.mean.filter(Number.isFinite));
  const top = [truth, ...lines].flatMap(({ mean }) => [...mean]).map((value) => Math.min(value, roof));
  const plot = new Plot(frameAxis(tab, 4), spanning(top, { log: false }), { xLabel: "frame", yLabel: "kinetic energy [mass length²/frame²]", width: 330, height: 240 });
  plot.band(lines[0].frames, lines[0].low, lines[0].high, "s0");
  [...lines].reverse().forEach(({ frames, mean, kind, name }) => plot.line(frames, mean, kind, name));
  plot.line(truth.frames, truth.mean, "truth", "truth");
  plot.series.reverse();
  const names = [["truth", "truth"], ...rows.map(([kind, one]) => [kind, short(one.name)])];
  return figure("Kinetic energy", [key(names), plot.draw("Kinetic energy over frames", "One line each for truth, entry and floors.")], "Mean over test scenarios; the band reaches from the lowest to the highest. Cut off at three times the truth's greatest.", { name: "energy", width: "third" });
}

function grid(head, rows, label, kind = "") {
  const cells = rows.map(([first, ...rest]) => el("tr", {}, el("th", { scope: "row" }, first), rest.map((cell) => el("td", {}, cell))));
  const whole = el("table", { class: kind }, el("thead", {}, el("tr", {}, head.map((text) => el("th", { scope: "col" }, text)))), el("tbody", {}, cells));
  return el("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": label }, whole);
}

function drawFrames(tab, row) {
  const names = Object.keys(row.at);
  if (!names.length) return null;
  const rows = names.map((name) => [withUnit(name), ...row.at[name].map((value) => written(number(value)))]);
  return el("section", {}, el("h3", {}, "At the frames of interest"), grid(["metric", ...tab.marked.map((frame) => `frame ${frame}`)], rows, "Scores at frames"));
}

function drawNumbers(tab, row) {
  const floors = floorsOf(tab, row).map(([, one]) => one);
  const rows = tab.metrics.filter((name) => row.values[tab.metrics.indexOf(name)]).map((name) => {
    const [, low, high] = row.values[tab.metrics.indexOf(name)];
    const interval = low === null || low === undefined ? "" : `${written(number(low))} … ${written(number(high))}`;
    return [withUnit(name), written(valueOf(tab, row, name)), interval, ...floors.map((one) => written(valueOf(tab, one, name)))];
  });
  const table = grid(["metric", "mean", "95 % interval", ...floors.map((one) => one.name)], rows, "Every metric");
  return el("details", { class: "numbers" }, el("summary", {}, `Every metric (${rows.length})`), table);
}
