"use strict";
const byId = id => document.getElementById(id);
const root = document.documentElement;
const colourOf = name => getComputedStyle(root).getPropertyValue(name).trim();
const themeListeners = [];
const report = { content: null, ready: null };

/** Text of a packed element: base64 of gzip. */
async function unpack(id) {
  const bytes = Uint8Array.from(atob(byId(id).textContent.trim()), c => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

function setTheme(name) {
  root.dataset.theme = name;
  themeListeners.forEach(listener => listener());
}

/** A row of buttons of which one is pressed; `choose(index)` is called for the first and for every click. */
function choices(box, labels, choose) {
  const buttons = labels.map((label, index) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = label;
    button.addEventListener("click", () => press(index));
    return button;
  });
  const press = index => {
    buttons.forEach((button, other) => button.setAttribute("aria-pressed", String(other === index)));
    choose(index);
  };
  box.replaceChildren(...buttons);
  if (buttons.length) press(0);
}

setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
byId("theme").addEventListener("click", () => setTheme(root.dataset.theme === "dark" ? "light" : "dark"));
report.ready = unpack("content-pack").then(text => { report.content = JSON.parse(text); return report.content; });

/** On paper the page is light, and what folds out is open. */
let unprinted = [];
addEventListener("beforeprint", () => {
  const theme = root.dataset.theme, folded = [...document.querySelectorAll("details:not([open])")];
  folded.forEach(part => { part.open = true; });
  setTheme("light");
  unprinted = [() => setTheme(theme), ...folded.map(part => () => { part.open = false; })];
});
addEventListener("afterprint", () => unprinted.splice(0).forEach(undo => undo()));
