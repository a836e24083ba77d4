/** Forms: a choice in a menu is applied at once, and URLs contain no empty values. */

/** @param {HTMLFormElement} form @param {boolean} off */
function silence(form, off) {
  for (const field of form.elements) {
    if (field.name && (!off || field.value === "")) field.disabled = off;
  }
}

for (const form of document.querySelectorAll("form[action]")) {
  form.addEventListener("submit", () => silence(form, true));
  addEventListener("pageshow", () => silence(form, false)); // also after the Back button
  if ("auto" in form.dataset) {
    form.addEventListener("change", (event) => {
      if (event.target instanceof HTMLSelectElement) form.requestSubmit();
    });
  }
  form.querySelector("textarea")?.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) form.requestSubmit();
  });
}
