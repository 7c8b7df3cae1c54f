// The elements of the page.

export function element(name, properties = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(properties)) {
    if (key === "class") made.className = value;
    else if (key === "style") made.style.cssText = value;
    else if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

// A row of buttons of which one is pressed; `chosen` is called with its value.
export function choice(label, options, chosen) {
  const buttons = Object.entries(options).map(([value, [words, title]]) =>
    element("button", { "data-value": value, title, "aria-pressed": "false", onclick: () => chosen(value) }, words)
  );
  const group = element("div", { class: "choice", role: "group", "aria-label": label }, element("span", {}, label), ...buttons);
  group.show = (value) => {
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.value === value));
  };
  return group;
}

// A labelled check box with the colour of what it shows.
export function toggle(name, words, colour, checked, changed, title = "") {
  const box = element("input", { type: "checkbox", name });
  box.checked = checked;
  box.addEventListener("change", () => changed(box.checked));
  const swatch = element("i", { style: `background:${colour}` });
  const label = element("label", { class: "toggle", title }, box, swatch, words);
  label.box = box;
  return label;
}

export function panels(root, scene) {
  const parts = {
    heading: element("h1", {}, scene.title),
    verdict: element("p", { class: "verdict", role: "status" }),
    flights: element("div", { class: "flights", role: "group", "aria-label": "Flights" }),
    about: element("button", { name: "about", title: "Figures for print, and what this replay was made of" }, "figures, origin"),
    canvas: element("canvas", { tabindex: "0", "aria-label": "The target and the flights around it" }),
    labels: element("div", { class: "labels" }),
    controls: element("div", { class: "inside" }),
    status: element("p", { class: "status" }),
    note: element("p", { class: "note", role: "note" }),
    triad: document.createElementNS("http://www.w3.org/2000/svg", "svg"),
    bar: element("div", { class: "bar" }),
    plots: element("aside", { class: "plots" }),
    transport: element("footer", { class: "transport" }),
    still: element("img", { class: "still", alt: "The replay when it was printed" }),
  };
  parts.folded = element("details", { class: "controls" }, element("summary", {}, "Show"), parts.controls); // closed on a phone
  parts.folded.open = innerWidth > 760;
  parts.triad.setAttribute("class", "triad");
  parts.triad.setAttribute("viewBox", "-60 -60 120 120");
  parts.stage = element("div", { class: "stage" }, parts.canvas, parts.labels, parts.folded, parts.status, parts.note, parts.triad, parts.bar);
  root.append(
    element("header", {}, parts.heading, parts.verdict, parts.about, parts.flights),
    parts.stage,
    parts.plots,
    parts.transport,
    parts.still
  );
  return parts;
}

export function metres(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  return `${value.toFixed(size < 10 ? 3 : size < 100 ? 2 : 1)} m`;
}
