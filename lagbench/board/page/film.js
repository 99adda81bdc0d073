// A rollout as a film: the truth and the prediction side by side.

const SECONDS = 9;
const TRAIL = 7;
const TRAIL_LENGTH = 0.05;
const quiet = matchMedia("(prefers-reduced-motion: reduce)");

/** Return whether a step along x and y is shorter by whole periods: then the particle left on one side and came in on the other. */
function isWrapped(periods, x, y) {
  return periods.some(([px, py]) => 2 * Math.abs(x * px + y * py) > px * px + py * py);
}

/** Return positions of all particles at a time between the stored frames (Catmull-Rom). A particle jumps where it leaves a periodic box. */
function positionsAt(film, count, frames, time, periods = []) {
  const last = frames - 1;
  const at = Math.min(last, Math.max(0, time));
  const i = Math.min(last - 1, Math.floor(at));
  const t = last > 0 ? at - i : 0;
  const weights = last > 0 ? [((2 - t) * t - 1) * t / 2, ((3 * t - 5) * t * t + 2) / 2, ((4 - 3 * t) * t + 1) * t / 2, (t - 1) * t * t / 2] : [0, 1, 0, 0];
  const rows = [i - 1, i, i + 1, i + 2].map((k) => 2 * count * Math.min(last, Math.max(0, k)));
  const found = new Float64Array(2 * count);
  const isCut = (from, to) => isWrapped(periods, film[to] - film[from], film[to + 1] - film[from + 1]);
  for (let k = 0; k < found.length; k += 2) {
    const places = rows.map((row) => row + k);
    if (periods.length) {
      if (isCut(places[1], places[2])) places.fill(places[t < 0.5 ? 1 : 2]);
      if (isCut(places[0], places[1])) places[0] = places[1];
      if (isCut(places[2], places[3])) places[3] = places[2];
    }
    for (let j = 0; j < 4; j += 1) {
      found[k] += weights[j] * film[places[j]];
      found[k + 1] += weights[j] * film[places[j] + 1];
    }
  }
  return found;
}

/** Return the frames between the points of a trail: the slower most particles are, the more, so that slow flows show. */
function trailGap(film, count) {
  const steps = [];
  for (let k = 0; k + 2 * count < film.length; k += 2) steps.push(Math.hypot(film[k + 2 * count] - film[k], film[k + 1 + 2 * count] - film[k + 1]));
  const median = steps.sort((a, b) => a - b)[steps.length >> 1] || 1;
  return Math.min(1.5, Math.max(0.35, TRAIL_LENGTH / (TRAIL * median)));
}

/** Return a colour per particle: its material, or where it started, so that mixing shows. */
function particleColours(materials, first) {
  const one = materials.every((material) => material === materials[0]);
  const style = getComputedStyle(document.documentElement);
  if (!one) return materials.map((material) => BOARD.colours.materials[material] ?? BOARD.colours.materials[0]);
  const shades = [0, 1, 4].map((k) => style.getPropertyValue(`--c${k}`).trim());
  return materials.map((_, k) => shades[Math.min(2, Math.max(0, Math.floor(3 * first[2 * k])))]);
}

/** Plays one film on two canvases, `pixels` wide; `ended` is called `rest` seconds after its last frame, `stop` ends it. */
class Film {
  constructor({ frames, materials, sides, obstacle = null, periods = [] }, { pixels = 560, rest = 0, ended = () => this.toggle(false) } = {}) {
    Object.assign(this, { frames, materials, sides, obstacle, periods, rest, ended, rested: 0 });
    this.time = 0;
    this.playing = false;
    this.canvases = this.sides.map(([name]) => el("canvas", { width: pixels, height: pixels, class: "film", role: "img", "aria-label": `Particles of ${name}` }));
    this.play = button("Play", () => this.toggle(), { class: "plain play" });
    this.slider = el("input", { type: "range", min: 0, max: this.frames.length - 1, step: "any", value: 0, "aria-label": "Frame of the film" });
    this.slider.addEventListener("input", () => this.show(Number(this.slider.value)));
    this.told = el("output", { class: "muted n" });
    this.gap = trailGap(this.sides[0][1], this.materials.length);
    this.start = positionsAt(this.sides[0][1], this.materials.length, this.frames.length, 0);
    this.repaint = () => {
      this.colours = particleColours(this.materials, this.start);
      this.obstacleColour = getComputedStyle(document.documentElement).getPropertyValue("--muted").trim();
      this.show(this.time);
    };
    document.addEventListener("schemechange", this.repaint);
    this.repaint();
  }

  element() {
    const sides = this.sides.map(([name], i) => el("div", {}, el("p", { class: "panels-title" }, name), el("div", { class: "panel" }, this.canvases[i])));
    return [el("div", { class: "films" }, sides), el("div", { class: "film-tools" }, this.play, this.slider, this.told)];
  }

  toggle(wanted = !this.playing) {
    this.playing = wanted;
    this.play.textContent = wanted ? "Pause" : "Play";
    if (!wanted) return;
    if (this.time >= this.frames.length - 1) this.time = 0;
    let before = null;
    const step = (now) => {
      if (!this.playing) return;
      const passed = before === null ? 0 : (now - before) / 1000;
      before = now;
      this.show(this.time + (passed * (this.frames.length - 1)) / SECONDS);
      this.rested = this.time < this.frames.length - 1 ? 0 : this.rested + passed;
      // What follows the end stops the film or starts it itself: a second loop would run beside this one.
      if (this.time >= this.frames.length - 1 && this.rested >= this.rest) this.ended();
      else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  show(time) {
    this.time = Math.min(time, this.frames.length - 1);
    this.slider.value = this.time;
    this.told.textContent = `frame ${this.frames[Math.round(this.time)]}`;
    this.sides.forEach(([, film], i) => this.paint(this.canvases[i], film));
  }

  paint(canvas, film) {
    const context = canvas.getContext("2d");
    const { width } = canvas;
    const count = this.materials.length;
    const radius = 1.5 + width / 160;
    context.clearRect(0, 0, width, width);
    if (this.obstacle) this.paintObstacle(context, width);
    const path = [];
    for (let k = TRAIL; k >= 0; k -= 1) {
      if (this.time - this.gap * k >= 0) path.push(positionsAt(film, count, this.frames.length, this.time - this.gap * k, this.periods));
    }
    const place = (spots, k) => [width * spots[2 * k], width * (1 - spots[2 * k + 1])];
    for (let k = 0; k < count; k += 1) {
      context.strokeStyle = context.fillStyle = this.colours[k];
      context.globalAlpha = 0.3;
      context.lineWidth = radius / 2;
      context.beginPath();
      path.forEach((spots, j) => {
        const before = path[Math.max(0, j - 1)];
        const isCut = isWrapped(this.periods, spots[2 * k] - before[2 * k], spots[2 * k + 1] - before[2 * k + 1]);
        if (j && !isCut) context.lineTo(...place(spots, k));
        else context.moveTo(...place(spots, k));
      });
      context.stroke();
      context.globalAlpha = 0.9;
      context.beginPath();
      context.arc(...place(path.at(-1), k), radius, 0, 2 * Math.PI);
      context.fill();
    }
  }

  /** Paint the fixed obstacle under the particles. */
  paintObstacle(context, width) {
    const [x, y, radius] = this.obstacle;
    context.globalAlpha = 1;
    context.fillStyle = this.obstacleColour;
    context.beginPath();
    context.arc(width * x, width * (1 - y), width * radius, 0, 2 * Math.PI);
    context.fill();
  }

  stop() {
    this.toggle(false);
    document.removeEventListener("schemechange", this.repaint);
  }
}

/** Return the film of a row beside the truth. */
function filmOf(tab, row) {
  return {
    frames: row.pictures.filmFrames,
    materials: row.pictures.material,
    obstacle: row.pictures.obstacle,
    periods: tab.periods,
    sides: [["truth", numbersOf(tab.truth.film)], [short(row.name), numbersOf(row.pictures.film)]],
  };
}

function drawFilm(tab, row) {
  const film = new Film(filmOf(tab, row));
  const caption = `${film.materials.length} of the particles of scenario ${row.pictures.scenario}, ${film.frames.length} frames and what lies between them.`;
  return [figure("Rollout", film.element(), caption, { width: "wide", name: "film" }), film];
}
