// Variants of a method stand behind it, folded until the reader asks for them.

/** Show or hide the variants of a method in a table. */
function foldVariants(button, isOpen) {
  button.setAttribute("aria-expanded", isOpen);
  const body = button.closest("table");
  for (const line of body.querySelectorAll(`tr[data-variant-of="${CSS.escape(button.dataset.fold)}"]`)) {
    line.classList.toggle("folded", !isOpen);
  }
}

function linkFolds() {
  for (const one of document.querySelectorAll("button.fold")) {
    one.addEventListener("click", () => foldVariants(one, one.getAttribute("aria-expanded") !== "true"));
  }
}
