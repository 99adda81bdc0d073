// Sets the scheme before the first paint.
(() => {
  "use strict";
  try {
    const chosen = localStorage.getItem("lagbench-theme");
    if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
  } catch {
    // storage may be forbidden: the scheme of the system holds
  }
  document.documentElement.classList.add("js");
})();
