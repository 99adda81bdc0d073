// Above the fold: the truth beside the leader of a tab; on the overview beside the first method of the first table.

const hero = { holder: document.getElementById("hero"), isWanted: !quiet.matches, film: null, shown: null };

/** Return the tab of the first film. */
function heroTab() {
  return BOARD.hero && BOARD.tabs.find((tab) => tab.id === BOARD.hero.tab);
}

/** Show the film of a tab; on the overview the first one. */
function setHero(tab) {
  const shownTab = tab ?? heroTab();
  const isFirst = Boolean(shownTab) && shownTab === heroTab() && (!tab || leaderOf(tab)?.id === BOARD.hero.entry);
  const shown = `${shownTab?.id} ${isFirst}`;
  if (!hero.holder || shown === hero.shown) return;
  hero.shown = shown;
  drawHero(shownTab, isFirst);
}

/** Return what the film of a tab shows: the first film has all particles that are known. */
function heroFilm(tab, leader, isFirst) {
  if (!isFirst) return filmOf(tab, leader);
  const { frames, material, films, obstacle } = BOARD.hero;
  return { frames, materials: material, obstacle, periods: tab.periods, sides: [["truth", numbersOf(films[0])], [`model: ${short(leader.name)}`, numbersOf(films[1])]] };
}

function drawHero(tab, isFirst) {
  hero.film?.stop();
  const leader = isFirst ? tab.rows.find((row) => row.id === BOARD.hero.entry) : tab && leaderOf(tab);
  const isShown = isFirst || Boolean(leader?.pictures);
  const content = isShown ? heroFilm(tab, leader, isFirst) : null;
  const isOfOneMaterial = new Set(content?.materials).size === 1;
  hero.film = isShown ? new Film(content, { pixels: 440, rest: 1.2, ended: nextHero }) : null;
  hero.holder.hidden = !isShown;
  if (!isShown) return;
  hero.film.play.addEventListener("click", () => { hero.isWanted = hero.film.playing; });
  const by = columnOf(tab, "skill") ? "skill" : tab.ranking;
  const address = addressOf({ ...readAddress(tab.id), entry: leader.id });
  const caption = el(
    "figcaption",
    {},
    el("strong", {}, `${tab.split} ${tab.size}`),
    ": the truth beside ",
    el("a", { href: address }, short(leader.name)),
    ` (${columnOf(tab, by).label} ${textOf(tab, leader, by)}).`,
    isFirst ? materialKey() : null,
    isOfOneMaterial ? " A colour tells where a particle started." : null,
  );
  hero.holder.replaceChildren(...hero.film.element(), caption);
  playHero();
}

/** Return the names of the materials in their colours. */
function materialKey() {
  if (BOARD.hero.key.length < 2) return null;
  return el("span", { class: "materials" }, BOARD.hero.key.map(([material, name]) => {
    const dot = svg("svg", { viewBox: "0 0 10 10", width: 10, height: 10, "aria-hidden": "true" }, svg("circle", { cx: 5, cy: 5, r: 4.5, fill: BOARD.colours.materials[material] }));
    return el("span", {}, dot, ` ${name}`);
  }));
}

/** Play unless the reader does not want it or reads a panel. */
function playHero() {
  const isWanted = hero.isWanted && !panel.open;
  if (hero.film && hero.film.playing !== isWanted) hero.film.toggle();
}

/** Begin again. */
function nextHero() {
  hero.film.toggle(false);
  playHero();
}
