// Above the fold: the truth beside the leader of the data set in view; on the overview one data set after another.

const hero = { holder: document.getElementById("hero"), isWanted: !quiet.matches, film: null, tab: null, isCycling: false };

function tabsWithLeader() {
  return BOARD.tabs.filter(leaderOf);
}

/** Show the film of a tab; without one, of all tabs in turn. */
function setHero(tab) {
  hero.isCycling = !tab;
  const tabs = tabsWithLeader();
  const next = tab ?? (tabs.includes(hero.tab) ? hero.tab : tabs[0]);
  if (next !== hero.tab) drawHero(next);
}

function drawHero(tab) {
  hero.film?.stop();
  const leader = tab && leaderOf(tab);
  hero.tab = tab;
  hero.film = leader ? new Film(tab, leader, { pixels: 440, rest: 1.2, ended: nextHero }) : null;
  hero.holder.hidden = !leader;
  if (!leader) return;
  hero.film.play.addEventListener("click", () => { hero.isWanted = hero.film.playing; });
  const key = columnOf(tab, "skill") ? "skill" : tab.ranking;
  const address = addressOf({ ...readAddress(tab.id), entry: leader.id });
  const caption = el(
    "figcaption",
    {},
    el("strong", {}, `${tab.split} ${tab.size}`),
    ": the truth, and the leader of the table, ",
    el("a", { href: address }, short(leader.name)),
    ` (${columnOf(tab, key).label} ${textOf(tab, leader, key)}).`,
  );
  hero.holder.replaceChildren(...hero.film.element(), caption);
  playHero();
}

/** Play unless the reader does not want it or reads a panel. */
function playHero() {
  const isWanted = hero.isWanted && !panel.open;
  if (hero.film && hero.film.playing !== isWanted) hero.film.toggle();
}

/** Begin again, or with the next data set. */
function nextHero() {
  const tabs = tabsWithLeader();
  const next = tabs[(tabs.indexOf(hero.tab) + 1) % tabs.length];
  hero.film.toggle(false);
  if (hero.isCycling && next !== hero.tab) drawHero(next);
  else playHero();
}
