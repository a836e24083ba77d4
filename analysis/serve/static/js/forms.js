/**
 * Forms: a choice in a menu is applied at once, and URLs contain no empty values.
 *
 * The page loads this script before it shows a form, and the listeners are the document's: a choice
 * that is made while the page still loads is applied too.
 */

/** @param {HTMLFormElement} form @param {boolean} off */
function silence(form, off) {
  for (const field of form.elements) {
    if (field.name && (!off || field.value === "")) field.disabled = off;
  }
}

document.addEventListener("submit", ({ target }) => {
  if (target.hasAttribute("action")) silence(target, true);
});

addEventListener("pageshow", () => {
  for (const form of document.querySelectorAll("form[action]")) silence(form, false); // also after the Back button
});

document.addEventListener("change", ({ target }) => {
  if (target instanceof HTMLSelectElement && target.matches("form[action][data-auto] select")) target.form.requestSubmit();
});

document.addEventListener("keydown", ({ key, ctrlKey, metaKey, target }) => {
  if (key === "Enter" && (ctrlKey || metaKey) && target.matches("form[action] textarea")) target.form.requestSubmit();
});
