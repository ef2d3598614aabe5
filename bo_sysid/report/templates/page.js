"use strict";
(() => {
  const narrow = matchMedia("(max-width: 40rem)");
  const touched = matchMedia("(pointer: coarse)");
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const stores = [...document.querySelectorAll("script[data-figures]")];
  // Plotly would offer to send the figure to a server of its own.
  const options = { responsive: true, displaylogo: false, showSendToCloud: false, plotlyServerURL: "",
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "resetCameraLastSave3d"] };

  const AXIS = 45; // height of an axis' numbers and its title

  // The wheel is for the page: over a scene Plotly would keep it.
  for (const place of document.querySelectorAll(".plot")) {
    place.addEventListener("wheel", (e) => e.stopPropagation(), { capture: true });
  }

  // Plotly's own layout does not know how wide the page is, nor its colours.
  function layoutFor(figure) {
    const layout = structuredClone(figure.layout);
    const style = getComputedStyle(document.documentElement);
    layout.font = { ...layout.font, color: style.getPropertyValue("--soft").trim() };
    if (narrow.matches) {
      layout.margin = { ...layout.margin, l: 55, r: 8 };
      layout.font.size = 11;
      if (layout.meta?.narrow) layout.xaxis.range = layout.meta.narrow;
    }
    if (touched.matches && !layout.scene) layout.dragmode = false; // a finger moves the page
    layout.autosize = true;
    return layout;
  }

  // Words in a figure have others in their customdata that fit a narrow page; the caption says all.
  function dataFor(figure) {
    const other = (t) => narrow.matches && t.mode === "text" && t.customdata;
    return figure.data.map((t) => (other(t) ? { ...t, text: t.customdata } : t));
  }

  // Keys of an object that are whole numbers come first: a menu knows which figure is the first.
  function firstOf(store, figures) {
    const select = document.querySelector(`select[data-for="${store.dataset.figures}"]`);
    return select ? select.value : Object.keys(figures)[0];
  }

  function draw(store, label) {
    const figures = JSON.parse(store.textContent);
    const shown = label ?? firstOf(store, figures);
    const figure = figures[shown];
    const place = document.getElementById(store.dataset.figures);
    place.dataset.shown = shown;
    const layout = layoutFor(figure);
    place.style.height = layout.height + "px";
    return Plotly.react(place, dataFor(figure), layout, options).then(() => makeRoom(place, layout));
  }

  // The legend has as many lines as the width asks for; the axis and its title are above it.
  function makeRoom(place, layout) {
    const legend = place.querySelector(".legend");
    const lacking = legend ? Math.ceil(legend.getBoundingClientRect().height) + AXIS - layout.margin.b : 0;
    if (lacking <= 0) return place;
    place.style.height = layout.height + lacking + "px";
    return Plotly.relayout(place, { "margin.b": layout.margin.b + lacking, height: layout.height + lacking });
  }

  function drawAll() {
    for (const store of stores) {
      draw(store, document.getElementById(store.dataset.figures).dataset.shown);
    }
  }

  for (const select of document.querySelectorAll("select[data-for]")) {
    const store = stores.find((s) => s.dataset.figures === select.dataset.for);
    select.addEventListener("change", () => draw(store, select.value));
  }
  dark.addEventListener("change", drawAll);
  narrow.addEventListener("change", drawAll);

  // One figure at a time, after the words are on the screen.
  let next = 0;
  function step() {
    if (next >= stores.length) {
      document.documentElement.dataset.ready = "yes";
      return;
    }
    draw(stores[next++]).then(() => setTimeout(step));
  }
  setTimeout(step, 50);
  {% if live %}

  // A run that is going on: the page asks whether there is news.
  let version = null;
  setInterval(async () => {
    try {
      const now = await (await fetch("version")).text();
      if (version !== null && now !== version) location.reload();
      version = now;
    } catch { /* the server has ended */ }
  }, 2000);
  {% endif %}
})();
