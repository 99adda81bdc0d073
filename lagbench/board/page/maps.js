// Vorticity as pictures: blue turns clockwise, vermilion counter-clockwise, clear is no vorticity.

const CLOCKWISE = channelsOf(BOARD.colours.clockwise);
const COUNTER_CLOCKWISE = channelsOf(BOARD.colours.counterClockwise);

/** Return red, green and blue of a colour such as #0072b2. */
function channelsOf(colour) {
  return [1, 3, 5].map((start) => Number.parseInt(colour.slice(start, start + 2), 16));
}

/** Return a canvas that shows values at nodes, x node first, clear at 0 and full at the limit. */
function fieldCanvas(values, nodes, limit, label) {
  const canvas = el("canvas", { width: nodes, height: nodes, class: "field", role: "img", "aria-label": label });
  const context = canvas.getContext("2d");
  const image = context.createImageData(nodes, nodes);
  for (let x = 0; x < nodes; x += 1) {
    for (let y = 0; y < nodes; y += 1) {
      const value = values[x * nodes + y];
      const at = 4 * ((nodes - 1 - y) * nodes + x);
      if (Number.isNaN(value)) image.data.set([128, 128, 128, 34], at);
      else image.data.set([...(value < 0 ? CLOCKWISE : COUNTER_CLOCKWISE), 255 * Math.min(1, Math.abs(value) / limit)], at);
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

function greatest(field) {
  return field.reduce((top, value) => (Math.abs(value) > top ? Math.abs(value) : top), 0);
}

function drawMaps(tab, row) {
  const { nodes } = row.pictures;
  const frames = row.pictures.mapFrames;
  if (!frames.length) return null;
  const truth = tab.truth.maps.map(numbersOf);
  const guess = row.pictures.maps.map(numbersOf);
  const residual = guess.map((field, i) => field.map((value, k) => value - truth[i][k]));
  const limits = [truth, truth, residual].map((fields) => fields.map(greatest));
  const names = ["truth", "prediction", "residual"];
  const cells = [truth, guess, residual].map((fields, side) => [
    el("span", { class: "side" }, names[side]),
    fields.map((field, i) => el("div", { class: "panel" }, fieldCanvas(field, nodes, limits[side][i] || 1, `${names[side]} at frame ${frames[i]}`))),
  ]);
  const grid = el("div", { class: "panels" }, [
    el("span"),
    frames.map((frame, i) => el("span", { class: "time" }, `frame ${frame}`, el("br"), `±${written(limits[0][i], 2)}, residual ±${written(limits[2][i], 2)}`)),
    cells,
  ]);
  grid.style.gridTemplateColumns = `4.6rem repeat(${frames.length}, minmax(6.5rem, 15rem))`;
  const ramp = el("div", { class: "scale" }, "−", el("span", { class: "ramp diverging" }), "+", el("span", { class: "muted" }, "full colour at the values above each frame"));
  const body = [ramp, el("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Vorticity maps" }, grid)];
  return figure("Vorticity", body, `Scenario ${row.pictures.scenario}, in 1/frame. The residual is predicted minus true and has a scale of its own.`, {
    width: "wide",
    name: "maps",
  });
}

/** Return figures of distributions at a frame that the reader chooses. */
function drawHistograms(tab, row) {
  const frames = row.pictures.mapFrames;
  if (!frames.length) return null;
  const residual = (i) => [["s0", "predicted minus true", histogramOf(row.residuals[i])]];
  const values = (i) => [
    ["truth", "truth", histogramOf(tab.truth.histograms[i])],
    ["s0", short(row.name), histogramOf(row.pictures.histograms[i])],
  ];
  const where = `Shares of the nodes of scenario ${row.pictures.scenario}.`;
  return [
    overFrames("Residual of vorticity", frames, residual, where, "residual"),
    overFrames("Distribution of vorticity", frames, values, `${where} Bins of the truth's range.`, "distribution"),
  ];
}

function overFrames(title, frames, seriesAt, caption, name) {
  const holder = el("div");
  const show = (place) => {
    const series = seriesAt(Number(place)).filter(([, , histogram]) => histogram.shares.some(Number.isFinite));
    if (!series.length) return holder.replaceChildren(el("p", { class: "muted" }, "No vorticity field at this frame."));
    return holder.replaceChildren(key(series.map(([kind, label]) => [kind, label])), histogramChart(title, series));
  };
  const last = frames.length - 1;
  show(last);
  const tools = frames.length > 1 ? chooser("frame", frames.map((frame, i) => [String(i), String(frame)]), String(last), show) : null;
  return figure(title, holder, caption, { tools, name, width: "third" });
}

function histogramChart(title, series) {
  const low = Math.min(...series.map(([, , histogram]) => histogram.low));
  const high = Math.max(...series.map(([, , histogram]) => histogram.high));
  const shares = series.flatMap(([, , histogram]) => [...histogram.shares]);
  const plot = new Plot(linear(low, high, { count: 4, tight: true }), spanning(shares, { log: false }), {
    xLabel: "vorticity [1/frame]",
    yLabel: "share of nodes",
    width: 330,
    height: 240,
  });
  series.forEach(([kind, label, histogram]) => plot.steps(histogram.low, histogram.high, histogram.shares, kind, label));
  return plot.draw(title, "A histogram.");
}
