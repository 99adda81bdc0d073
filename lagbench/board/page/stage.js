// Above the fold: the truth beside the leader of the data set in view; on the overview one data set after another.

const stage = { holder: document.getElementById("stage"), wanted: !quiet.matches, film: null, tab: null, cycling: false };

/** Show the film of a tab; without one, of all tabs in turn. */
function setStage(tab) {
  stage.cycling = !tab;
  const staged = BOARD.tabs.filter(leaderOf);
  const next = tab ?? (staged.includes(stage.tab) ? stage.tab : staged[0]);
  if (next !== stage.tab) drawStage(next);
}

function drawStage(tab) {
  stage.film?.stop();
  const leader = tab && leaderOf(tab);
  Object.assign(stage, { tab, film: leader ? new Film(tab, leader, { pixels: 440, rest: 1.2, ended: nextStage }) : null });
  stage.holder.hidden = !leader;
  if (!leader) return;
  stage.film.play.addEventListener("click", () => { stage.wanted = stage.film.playing; });
  const by = columnOf(tab, "skill") ? "skill" : tab.ranking;
  const link = el("a", { href: addressOf({ ...readAddress(tab.id), entry: leader.id }) }, short(leader.name));
  stage.holder.replaceChildren(
    ...stage.film.element(),
    el("figcaption", {}, el("strong", {}, `${tab.split} ${tab.size}`), ": the truth, and the leader of the table, ", link, ` (${columnOf(tab, by).label} ${textOf(tab, leader, by)}).`),
  );
  playStage();
}

/** Play unless the reader does not want it or reads a panel. */
function playStage() {
  if (stage.film && stage.film.playing !== (stage.wanted && !panel.open)) stage.film.toggle();
}

/** Begin again, or with the next data set. */
function nextStage() {
  const staged = BOARD.tabs.filter(leaderOf);
  const next = staged[(staged.indexOf(stage.tab) + 1) % staged.length];
  stage.film.toggle(false);
  if (stage.cycling && next !== stage.tab) drawStage(next);
  else playStage();
}
