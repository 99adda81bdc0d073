// Where an entry comes from, and how to make it again.

function drawOrigin(tab, row) {
  const about = [
    ["training", row.training],
    ["hardware, self-reported", row.hardware],
    ["seeds", row.floor ? "" : String(row.seeds)],
    ["licence", row.licence],
    ["submitted", row.date],
    ["scored by", row.scored],
    ["notes", row.notes],
  ].filter(([, text]) => text);
  return el("section", { class: "origin" }, [
    row.command ? [el("h3", {}, "The same predictions again"), commandBox(row.command)] : null,
    el("h3", {}, "About"),
    el("dl", {}, about.map(([name, text]) => [el("dt", {}, name), el("dd", {}, text)])),
    row.predictions.length ? predictionTable(tab, row) : null,
  ]);
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

function predictionTable(tab, row) {
  const rows = row.predictions.map((one) => [
    one.seed === null ? MISSING : String(one.seed),
    written(number(one.mean)),
    one.size === null ? MISSING : `${written(one.size / 1e6)} MB`,
    el("code", { title: one.sha256 }, one.sha256.slice(0, 16)),
    outward(one.url, "file") ?? (one.path ? el("code", {}, one.path) : MISSING),
    el("code", {}, one.score),
  ]);
  return [el("h3", {}, "Predictions"), grid(["seed", columnOf(tab.ranking).label, "size", "SHA-256", "predictions", "score file"], rows, "Predictions", "text")];
}

/** Return who made an entry and where its code and paper are. */
function drawByline(row) {
  const links = [outward(row.code, "Code"), outward(row.paper, "Paper")].filter(Boolean);
  const by = [row.authors, row.affiliation].filter(Boolean).join(" · ");
  return el("p", { class: "by" }, [by, links.map((link) => [" · ", link]), chips(row)]);
}

/** Return how an entry stands beside the leader, in a sentence. */
function drawStanding(tab, row) {
  if (row.floor) return "A floor that the scorer computes itself.";
  if (row.rank === null) return "Not ranked.";
  const place = `Rank ${rankText(row)} by ${columnOf(tab.ranking).label}`;
  const p = number(row.p);
  if (row === leaderOf(tab) || Number.isNaN(p)) return `${place}.`;
  return p < 0.05 ? `${place}; it differs from the leader (p = ${written(p, 2)}).` : `${place}; it cannot be told from the leader at 5 % (p = ${written(p, 2)}).`;
}
