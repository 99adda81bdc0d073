// What opens for an entry: how it fares, frame by frame and scenario by scenario.

/** Return the content of the panel and its film. */
function drawDetail(tab, state, row) {
  const [filmFigure, film] = row.pictures ? drawFilm(tab, row) : [null, null];
  const content = [
    drawTiles(tab, row),
    drawFlags(row),
    el("div", { class: "figures" }, [drawErrors(tab, row), drawScenarios(tab, row), row.pictures ? drawMaps(tab, row) : null, filmFigure, drawEnergy(tab, row), row.pictures ? drawHistograms(tab, row) : null]),
    drawUnpictured(tab, row),
    drawFrames(tab, row),
    drawNumbers(tab, row),
    drawOrigin(row),
  ];
  return [content, film];
}

/** Return why an entry has no maps and no film; null where it has them, and for variants, whose method has them. */
function drawUnpictured(tab, row) {
  if (row.pictures || row.variantOf || !tab.pictured) return null;
  return el("p", { class: "muted" }, `The page has maps and films of the first ${tab.pictured} methods of each data set.`);
}

/** Return the reference predictors of a tab, each with the class of its marks. */
function referencesOf(tab) {
  return tab.references.map((reference, i) => [`reference${i}`, reference]);
}

function leaderOf(tab) {
  return tab.rows.find((row) => row.rank) ?? tab.rows.find((row) => row.active && row.pictures);
}

function drawTiles(tab, row) {
  const keys = [...tab.presets.main.slice(0, 5), "seconds_per_frame", "parameters"];
  const tiles = keys.filter((key) => !isGap(valueOf(tab, row, key))).map((key) => {
    const isTime = key === "speed_up" || key === "seconds_per_frame";
    const more = isTime ? textOf(tab, row, "device") : noteOf(tab, row, key);
    return el("li", {}, el("span", { class: "what" }, columnOf(tab, key).quantity), el("span", { class: "big" }, textOf(tab, row, key)), el("span", { class: "more" }, more));
  });
  return el("ul", { class: "tiles" }, tiles);
}

/** Return the marks beside the name in the table with their meanings. */
function drawFlags(row) {
  const items = row.flags.map(([kind, label, meaning]) => {
    const chip = el("span", { class: `flag ${kind}`, title: meaning }, label);
    return el("li", {}, chip, el("span", {}, meaning));
  });
  return items.length ? el("ul", { class: "flags" }, items) : null;
}

function drawErrors(tab, row) {
  const leader = leaderOf(tab);
  const rows = [["s0", row], ...(leader && leader !== row ? [["s1", leader]] : []), ...referencesOf(tab)];
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
  const options = Object.keys(row.spread).map((name) => [name, columnOf(tab, name).label]);
  const rows = [["s0", row], ...referencesOf(tab)];
  const holder = el("div");
  const show = (by) => holder.replaceChildren(key(rows.map(([kind, one]) => [kind, short(one.name)]), spot), scenarioChart(tab, by, rows));
  if (options.length) show(options[0][0]);
  return figure("Every test scenario", holder, "Means over the horizon. Grey: reference predictors.", {
    tools: options.length > 1 ? chooser("of", options, options[0][0], show) : null,
    name: "scenarios",
  });
}

const MOST_LABELS = 16; // scenarios with a label below the chart

function scenarioChart(tab, by, rows) {
  const held = rows.map(([kind, row]) => [kind, short(row.name), row.spread[by] ? [...numbersOf(row.spread[by])] : []]);
  const count = tab.scenarios.length;
  const every = Math.ceil(count / MOST_LABELS);
  const places = { low: -0.5, high: count - 0.5, share: (value) => (value + 0.5) / count, factor: "", ticks: tab.scenarios.map((id, i) => ({ value: i, label: i % every ? "" : String(id) })) };
  const plot = new Plot(places, spanning(held.flatMap(([, , values]) => values)), { xLabel: "scenario", yLabel: columnOf(tab, by).quantity });
  [...held].reverse().forEach(([kind, name, values]) => values.forEach((value, i) => {
    if (!Number.isFinite(value)) return;
    const mark = spot(kind, plot.column(i), plot.row(value));
    mark.append(svg("title", {}, `${name}, scenario ${tab.scenarios[i]}: ${written(value)}`));
    plot.marks.push(mark);
  }));
  return plot.draw(`${columnOf(tab, by).label} of every test scenario`, held.map(([, name, values]) => `${name}: ${values.map((v) => written(v)).join(", ")}`).join(". "));
}

/** Shapes of marks of reference predictors around their middle, after the circle. */
const SHAPES = [
  "m-4 0l4 -4l4 4l-4 4Z",
  "m0 -4.5l4.2 7.5h-8.4Z",
  "m-3.4 -3.4h6.8v6.8h-6.8Z",
  "m0 4.5l4.2 -7.5h-8.4Z",
  "m-4 0h8m-4 -4v8",
  "m-3 -3l6 6m0 -6l-6 6",
  "m-4 0h8",
  "m-4 0h8m-4 -4v8m-2.8 -6.8l5.6 5.6m0 -5.6l-5.6 5.6",
];

/** Return a mark: a dot for an entry, a hollow shape of its own for a reference predictor. */
function spot(kind, x = 11, y = 5) {
  const number = /^reference.*?(\d)$/.exec(kind)?.[1] ?? 0;
  if (number > 0) return svg("path", { d: `M${x.toFixed(1)} ${y.toFixed(1)}${SHAPES[number - 1]}`, class: `spot ${kind}` });
  return svg("circle", { cx: x.toFixed(1), cy: y.toFixed(1), r: kind === "s0" ? 5 : 3.8, class: `spot ${kind}` });
}

function drawEnergy(tab, row) {
  const truth = curveOf(tab.energy);
  const rows = [["s0", row], ...referencesOf(tab)].filter(([, one]) => one.energy);
  const lines = rows.map(([kind, one]) => ({ kind, name: short(one.name), ...curveOf(one.energy) }));
  const roof = 3 * Math.max(...truth.mean.filter(Number.isFinite));
  const top = [truth, ...lines].flatMap(({ mean }) => [...mean]).map((value) => Math.min(value, roof));
  const plot = new Plot(frameAxis(tab, 4), spanning(top, { log: false }), { xLabel: "frame", yLabel: "kinetic energy [mass length²/frame²]", width: 330, height: 240 });
  plot.band(lines[0].frames, lines[0].low, lines[0].high, "s0");
  [...lines].reverse().forEach(({ frames, mean, kind, name }) => plot.line(frames, mean, kind, name));
  plot.line(truth.frames, truth.mean, "truth", "truth");
  plot.series.reverse();
  const names = [["truth", "truth"], ...rows.map(([kind, one]) => [kind, short(one.name)])];
  return figure("Kinetic energy", [key(names), plot.draw("Kinetic energy over frames", "One line each for truth, entry and reference predictors.")], "Mean over test scenarios; the band reaches from the lowest to the highest. Cut off at three times the truth's greatest.", { name: "energy", width: "third" });
}

function grid(head, rows, label, kind = "") {
  const cells = rows.map(([first, ...rest]) => el("tr", {}, el("th", { scope: "row" }, first), rest.map((cell) => el("td", {}, cell))));
  const whole = el("table", { class: kind }, el("thead", {}, el("tr", {}, head.map((text) => el("th", { scope: "col" }, text)))), el("tbody", {}, cells));
  return el("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": label }, whole);
}

function drawFrames(tab, row) {
  const names = Object.keys(row.at);
  if (!names.length) return null;
  const rows = names.map((name) => [columnOf(tab, name).quantity, ...row.at[name].map((value) => written(number(value)))]);
  return el("section", {}, el("h3", {}, "At the frames of interest"), grid(["metric", ...tab.marked.map((frame) => `frame ${frame}`)], rows, "Scores at frames"));
}

function drawNumbers(tab, row) {
  const keys = tab.presets.all.filter((key) => columnOf(tab, key).form === "number" && !Number.isNaN(valueOf(tab, row, key)));
  const rows = keys.map((key) => [columnOf(tab, key).quantity, textOf(tab, row, key), noteOf(tab, row, key), ...tab.references.map((reference) => textOf(tab, reference, key))]);
  const table = grid(["metric", "mean", "interval, spread", ...tab.references.map((reference) => reference.name)], rows, "Every metric");
  return el("details", { class: "numbers" }, el("summary", {}, `Every metric (${rows.length})`), table);
}

/** Return where an entry comes from, and how to make it again. */
function drawOrigin(row) {
  return el("section", { class: "origin" }, [
    row.command ? [el("h3", {}, "The same predictions again"), commandBox(row.command)] : null,
    el("h3", {}, "About"),
    el("dl", {}, row.about.map(([name, text, address]) => [el("dt", {}, name), el("dd", {}, address ? el("a", { href: address }, text) : text)])),
    el("h3", {}, "Predictions"),
    grid(["seed", "mean", "size", "SHA-256", "predictions", "score file"], row.predictions.map(predictionLine), "Predictions", "text"),
  ]);
}

function predictionLine({ seed, mean, size, sha256, url, path, scoreFile }) {
  const hash = el("code", { title: sha256 }, sha256.slice(0, 16));
  const inFolder = path ? el("code", {}, path) : MISSING;
  return [seed, mean, size, hash, outward(url, "file") ?? inFolder, el("code", {}, scoreFile)];
}

function commandBox(command) {
  const code = el("code", {}, command);
  const copy = button("Copy", async () => {
    copy.textContent = (await copied(command, code)) ? "Copied" : "Press Ctrl+C";
    setTimeout(() => { copy.textContent = "Copy"; }, 1600);
  }, { class: "plain copy", "aria-live": "polite" });
  return el("div", { class: "command" }, el("pre", {}, code), copy);
}

/** Copy text; where the browser forbids that, select it and say so. */
async function copied(text, element) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    getSelection().selectAllChildren(element);
    return document.execCommand("copy");
  }
}

/** Return who made an entry, with links to code, paper and weights. */
function drawByline(row) {
  const links = row.links.map(([label, address]) => {
    // Python lets only links of the web and paths of the leaderboard's folder through.
    const inFolder = el("a", { href: address }, label);
    return address.startsWith("http") ? outward(address, label) : inFolder;
  });
  const list = links.length ? [" · ", el("span", { class: "links" }, links)] : null;
  return el("p", { class: "by" }, row.byline, list);
}
