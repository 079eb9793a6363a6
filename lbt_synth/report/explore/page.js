"use strict";
// Sliders say what they want; curves, the table and the verdict come back from the server.
(function () {
  const byId = (id) => document.getElementById(id);
  const form = byId("controls"), method = byId("method"), root = document.documentElement;
  const knobs = [...form.querySelectorAll("input[type=range]")];
  let moved = {}, number = 0, slow = false, exchange = null, timer = 0;

  const limits = (knob) => [Number(knob.dataset.low), Number(knob.dataset.high)];
  function valueAt(knob) {
    const [low, high] = limits(knob), part = Number(knob.value) / Number(knob.max);
    const value = knob.dataset.log === "True" ? low * (high / low) ** part : low + (high - low) * part;
    return Number(value.toPrecision(4));
  }
  function place(knob, value) {
    const [low, high] = limits(knob);
    const part = knob.dataset.log === "True" ? Math.log(value / low) / Math.log(high / low)
                                             : (value - low) / (high - low);
    knob.value = Math.round(part * Number(knob.max));
  }
  function tell(knob) {
    const value = knob.id in moved ? moved[knob.id] : Number(knob.dataset.value);
    const text = `${Number((value * knob.dataset.factor).toPrecision(4))} ${knob.dataset.unit}`.trim();
    const output = knob.parentElement.querySelector("output");
    output.textContent = text;
    output.classList.toggle("moved", knob.id in moved);
    knob.setAttribute("aria-valuetext", text);
  }
  function show() {
    for (const knob of knobs) {
      const own = knob.parentElement.dataset.methods;
      knob.parentElement.hidden = own !== undefined && !own.split(" ").includes(method.value);
    }
  }
  function ask(final) {
    if (!exchange || (slow && !final)) return;
    number += 1;
    root.dataset.asked = number;
    byId("verdict").classList.add("old");
    clearTimeout(timer);
    timer = setTimeout(() => busy(true), 250);
    say({ do: "design", number, final, method: method.value, values: moved });
  }
  function say(message) { exchange.wish = JSON.stringify({ ...message, at: performance.now() }); }
  function busy(is) {
    clearTimeout(timer);
    byId("busy").hidden = !is;
    byId("_content").setAttribute("aria-busy", String(is));
  }
  function fail(text) {
    byId("error").textContent = text;
    byId("error").hidden = !text;
  }

  function element(tag, text, attributes = {}) {
    const made = document.createElement(tag);
    made.textContent = text;
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    return made;
  }
  function swatch(entry) {
    const space = "http://www.w3.org/2000/svg", svg = document.createElementNS(space, "svg");
    const path = document.createElementNS(space, "path");
    for (const [name, value] of [["class", "swatch"], ["viewBox", "0 0 34 14"], ["width", 34],
                                 ["height", 14], ["aria-hidden", "true"]]) svg.setAttribute(name, value);
    for (const [name, value] of [["d", "M0 7H34"], ["stroke", entry.colour], ["stroke-width", 2.2],
                                 ["stroke-dasharray", entry.dashes || "none"]]) path.setAttribute(name, value);
    svg.append(path);
    return svg;
  }
  function tabulate(answer) {
    const head = element("tr", "");
    head.append(...answer.headings.map((text) => element("th", text, { scope: "col" })));
    byId("facts").tHead.replaceChildren(head);
    byId("facts").tBodies[0].replaceChildren(...answer.legend.map((entry) => {
      const cells = answer.rows.find((row) => row[0] === entry.name) || [entry.name];
      const row = element("tr", ""), name = element("th", "", { scope: "row" });
      name.append(swatch(entry), entry.name);
      row.append(name, ...cells.slice(1).map((text) => element("td", text)));
      if (entry.kept) {
        const says = { type: "button", title: "Remove", "aria-label": `Remove ${entry.name}` };
        const button = element("button", "×", says);
        button.addEventListener("click", () => say({ do: "drop", name: entry.name }));
        name.append(" ", button);
      }
      return row;
    }));
  }
  function hear(answer) {
    if (!answer.error) slow = answer.slow;
    // what changes before the curves are painted makes each of them compute its styles again
    requestAnimationFrame(() => requestAnimationFrame(() => {
      if (answer.number === number) busy(false);
      fail(answer.error || "");
      if (!answer.error) tabulate(answer);
      else if (answer.number === number) byId("verdict").textContent = "";
      root.dataset[answer.whole || answer.error ? "whole" : "shown"] = answer.number;
      root.dataset.drawn = "yes";
    }));
  }
  function judge(verdict) {
    if (verdict.number !== number) return;
    byId("verdict").textContent = verdict.text;
    byId("verdict").classList.remove("old");
    root.dataset.judged = verdict.number;
  }
  function list(saved) {
    const box = byId("saved");
    if (saved.error) return box.replaceChildren(element("p", saved.error, { class: "notice bad" }));
    box.replaceChildren(element("p", `Written: ${saved.files.join(", ")}. The commands that make them:`),
                        element("pre", saved.commands.join("\n"), { tabindex: "0" }));
  }

  for (const knob of knobs) {
    for (const kind of ["input", "change"]) {
      knob.addEventListener(kind, () => {
        moved = { ...moved, [knob.id]: valueAt(knob) };
        tell(knob);
        ask(kind === "change");
      });
    }
  }
  method.addEventListener("change", () => { slow = false; show(); ask(true); });
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(() => { start(); ask(true); }));
  byId("keep").addEventListener("click", () => say({ do: "keep" }));
  byId("save").addEventListener("click", () => say({ do: "save" }));
  function start() {
    moved = {};
    for (const knob of knobs) { place(knob, Number(knob.dataset.value)); tell(knob); }
    show();
  }
  start();

  // at each paint Bokeh writes the same style sheets, and the browser computes them again
  function keepStyles() {
    const sheet = Bokeh.require("core/dom").InlineStyleSheet.prototype, write = sheet._update;
    sheet._update = function (css) { if (this.el.textContent !== css) write.call(this, css); };
  }

  const began = Date.now();
  const waiting = setInterval(() => {
    const page = window.Bokeh && Bokeh.documents[0];
    exchange = page ? page.get_model_by_name("exchange") : null;
    if (!exchange) {
      if (Date.now() - began > 10000) fail(`No connection. If you came by a tunnel, start with --origin ${location.host}.`);
      return;
    }
    clearInterval(waiting);
    fail("");
    keepStyles();
    for (const [name, take] of [["answer", hear], ["verdict", judge], ["saved", list]]) {
      const read = () => { if (exchange[name]) take(JSON.parse(exchange[name])); };
      exchange.properties[name].change.connect(read);
      read();
    }
    page.on_event("connection_lost", () => fail("The server has ended, or the connection is lost. Start it again and reload this page."));
  }, 20);
})();
