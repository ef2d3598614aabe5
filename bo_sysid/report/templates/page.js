"use strict";
(() => {
  const narrow = matchMedia("(max-width: 40rem)");
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const stores = [...document.querySelectorAll("script[data-figures]")];
  const options = { responsive: true, displaylogo: false,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "resetCameraLastSave3d"] };

  // Plotly's own layout does not know how wide the page is, nor its colours.
  function layoutFor(figure) {
    const layout = structuredClone(figure.layout);
    const style = getComputedStyle(document.documentElement);
    layout.font = { ...layout.font, color: style.getPropertyValue("--soft").trim() };
    if (narrow.matches) {
      layout.margin = { ...layout.margin, l: 55, r: 8 };
      layout.font.size = 11;
      if (figure.data.filter((t) => t.name && t.showlegend !== false).length > 2) { // a legend of several lines
        layout.margin.b += 50;
        layout.height += 50;
      }
    }
    layout.autosize = true;
    return layout;
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
    return Plotly.react(place, figure.data, layout, options);
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
