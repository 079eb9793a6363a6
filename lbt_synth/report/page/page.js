"use strict";
// A table that is wider than the screen says that it can be moved.
for (const place of document.querySelectorAll(".scroll")) {
  new ResizeObserver(() => {
    place.classList.toggle("wide", place.scrollWidth > place.clientWidth + 1);
  }).observe(place);
}
// The drawings in the page are replaced by charts with hover and zoom, if these can be made.
(async function () {
  const root = document.documentElement;
  try {
    const charts = JSON.parse(document.getElementById("_charts").textContent);
    if (window.matchMedia("(pointer: coarse)").matches) {
      // a finger scrolls the page: it zooms only after a tap on that tool
      for (const plot of charts.documents.page.roots) {
        plot.attributes.toolbar.attributes.active_drag = null;
      }
    }
    root.classList.add("live"); // places must have a size before they are drawn in
    await Bokeh.embed.embed_items(charts.documents, charts.items);
    const page = Bokeh.documents[0];
    for (const button of document.querySelectorAll(".legend button")) {
      button.addEventListener("click", () => {
        const shown = button.getAttribute("aria-pressed") !== "true";
        button.setAttribute("aria-pressed", String(shown));
        for (const id of button.dataset.lines.split(" ")) {
          page.get_model_by_id(id).visible = shown;
        }
      });
    }
    root.dataset.drawn = "yes";
  } catch (error) {
    root.classList.remove("live");
    console.error("the charts stay drawings:", error);
  }
})();
