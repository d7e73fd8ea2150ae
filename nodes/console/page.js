// Add to viser's page: names of its controls, titles of buttons, missing keys, and a message
// when the connection is lost.  It runs before viser's own script.
(() => {
  "use strict";

  document.title = "flexsheet console";

  const STOP = "E-STOP";
  const LOST =
    "There is no connection to the console. The page is out of date, and its e-stop does nothing. " +
    "Use the e-stop of the arms.";

  const VIEW =
    "3D view of arms, sheet, object and finger. The arrow keys rotate the view. The keys W, A, S, D, " +
    "Q and E move the view. The sliders in the tab Touch move the finger.";

  const stopButton = () =>
    [...document.querySelectorAll("#root button")].find((one) => one.textContent.startsWith(STOP));

  // viser ignores hotkeys while a text box has the focus; the e-stop must always work.
  addEventListener(
    "keydown",
    (event) => {
      if (event.key === "Escape" && event.target.matches("input, textarea, select"))
        stopButton()?.click();
    },
    true,
  );

  // Arrow keys that move a slider or change the tab must not rotate the 3D view.
  document.addEventListener("keydown", (event) => {
    if (event.key.startsWith("Arrow") && event.target.closest("[role=slider], [role=tab]"))
      event.stopPropagation();
  });

  const name = (element, text) => {
    if (element && text && element.getAttribute("aria-label") !== text)
      element.setAttribute("aria-label", text);
  };

  // Return the controls in the nearest element around a label.
  const controlsOf = (label) => {
    for (let box = label.parentElement; box; box = box.parentElement) {
      const found = box.querySelectorAll("input:not([type=hidden]), [role=slider]");
      if (found.length) return found;
    }
    return [];
  };

  const ICONS = {
    "list-search": "Commands and keys (Ctrl+K)",
    adjustments: "viser's own settings",
    "arrow-back": "Back to the console",
    maximize: "Show larger",
  };

  // viser does not show the hints of buttons.  The third text is for a disabled button.
  const TITLES = [
    [STOP, "Stop both arms immediately. Key: Escape"],
    ["Release the stop", "Reset the e-stop. The arms must be at rest"],
    [
      "Reset the fault",
      "Reset the faults of the arms. The arms must be at rest",
      "Disabled, because no e-stop is engaged and no arm reports a fault",
    ],
    ["Lift the finger", "Move the fingertip 30 mm off the object's surface. Key: L"],
    ["Lower the finger", "Move the fingertip to the depth of the slider Push. Key: L"],
  ];

  function titleButtons() {
    for (const button of document.querySelectorAll("#root button")) {
      const found = TITLES.find(([start]) => button.textContent.startsWith(start));
      if (found) button.title = button.disabled ? (found[2] ?? found[1]) : found[1];
    }
  }

  function nameControls() {
    for (const label of document.querySelectorAll("label[for]"))
      for (const control of controlsOf(label)) name(control, label.textContent);
    for (const [icon, text] of Object.entries(ICONS))
      for (const drawn of document.querySelectorAll(`button svg.tabler-icon-${icon}`))
        name(drawn.closest("button"), text);
    for (const image of document.querySelectorAll("img:not([alt])"))
      image.alt = image.parentElement.parentElement.textContent;
    for (const canvas of document.querySelectorAll("canvas[data-engine]")) {
      canvas.setAttribute("role", "img");
      name(canvas, VIEW);
    }
    for (const icon of document.querySelectorAll(
      ".mantine-Paper-root > svg.tabler-icon-chevron-up, " +
        ".mantine-Paper-root > svg.tabler-icon-chevron-down",
    )) {
      const heading = icon.parentElement;
      heading.setAttribute("role", "button");
      heading.setAttribute("tabindex", "0");
      const opened = icon.classList.contains("tabler-icon-chevron-up");
      heading.setAttribute("aria-expanded", String(opened));
    }
  }

  document.addEventListener("keydown", (event) => {
    const heading = event.target.closest(".mantine-Paper-root[role=button]");
    if (heading !== event.target || !["Enter", " "].includes(event.key)) return;
    event.preventDefault();
    heading.click();
  });

  // viser disables the mouse on its panels while it has no connection.
  const lost = document.createElement("p");
  lost.id = "fs-lost";
  lost.className = "fs-banner fs-ground-bad";
  lost.setAttribute("role", "alert");
  lost.hidden = true;
  const stop = document.createElement("button");
  stop.id = "fs-stop";
  stop.textContent = `${STOP} (Esc)`;
  stop.addEventListener("click", () => stopButton()?.click());
  let seen = false;
  setInterval(() => {
    const button = stopButton();
    seen ||= Boolean(button);
    const gone = seen && (!button || getComputedStyle(button).pointerEvents === "none");
    if (lost.hidden === !gone) return;
    lost.hidden = !gone;
    lost.textContent = gone ? LOST : "";
  }, 500);

  document.addEventListener("DOMContentLoaded", () => {
    const header = document.createElement("header");
    header.innerHTML = '<h1 class="fs-unseen">flexsheet console</h1>';
    header.append(stop);
    const root = document.getElementById("root");
    root.setAttribute("role", "main");
    root.before(header, lost);
    let due = false;
    new MutationObserver(() => {
      if (due) return;
      due = true;
      setTimeout(() => {
        due = false;
        nameControls();
        titleButtons();
      }, 100);
    }).observe(document.body, {
      childList: true,
      characterData: true,
      subtree: true,
      attributeFilter: ["disabled"],
    });
  });
})();
