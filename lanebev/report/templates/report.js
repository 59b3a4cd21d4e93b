"use strict";
(() => {
  const read = id => JSON.parse(document.getElementById(id).textContent);
  const byId = id => document.getElementById(id);
  const data = read("data"), plots = read("plots");
  const axes = ["pitch", "yaw", "roll", "height"], count = data.place.length;
  const pictured = data.place.map((place, i) => place in data.pictures ? i : -1).filter(i => i >= 0);
  const marks = [];
  let shown = 0;

  const nearest = (indices, distance) =>
    indices.reduce((best, i) => best < 0 || distance(i) < distance(best) ? i : best, -1);
  const all = data.place.map((_, i) => i);
  const at = x => nearest(all, i => Math.abs(data.x[i] - x));
  const number = (value, axis) => value === null ? "–" :
    axis === 3 ? `${value.toFixed(3)} m` : `${value.toFixed(2)}°`;
  const when = i => data.image ? data.image[i] : `frame ${data.frame[i]}` + (data.stills ? "" : `, ${data.x[i].toFixed(2)} s`);

  function show(i, keepAddress) {
    if (count === 0) return;
    shown = i = Math.min(Math.max(i, 0), count - 1);
    const picture = nearest(pictured, j => Math.abs(data.place[j] - data.place[i]));
    const images = picture < 0 ? {} : data.pictures[data.place[picture]];
    for (const name of ["image", "before", "after"]) {
      const img = byId(`picture-${name}`);
      if (images[name]) img.src = images[name];
      img.parentElement.hidden = !images[name];
    }
    const off = picture < 0 ? 0 : data.place[picture] - data.place[i];
    byId("picture-image").alt = picture < 0 ? "" : when(picture);
    byId("caption").textContent = picture < 0 ? "" : off === 0 ? when(picture) :
      `the nearest picture kept: ${when(picture)}, ${Math.abs(off)} frame${Math.abs(off) === 1 ? "" : "s"} ${off < 0 ? "earlier" : "later"}`;
    byId("moment-title").textContent = when(i);
    const status = byId("moment-status");
    status.textContent = data.status[i];
    status.className = `chip ${data.status[i].toLowerCase()}`;
    byId("moment-reasons").textContent = data.reasons[data.reason[i]];
    byId("moment-segments").textContent = data.segments[i];
    axes.forEach((axis, k) => {
      byId(`value-${axis}`).textContent = number(data.value[i][k], k);
      byId(`std-${axis}`).textContent = data.std[i][k] === null ? "–" : number(2 * data.std[i][k], k);
      byId(`state-${axis}`).textContent = data.states[data.state[i][k]];
    });
    const widths = data.after[i].filter(width => width !== null);
    byId("moment-widths").textContent = widths.length ? widths.map(width => `${width.toFixed(2)} m`).join(", ") : "not measured";
    if (byId("cursor")) {
      const [start, end] = data.range;
      byId("cursor").style.left = `${100 * (data.x[i] - start) / (end - start)}%`;
      byId("slider").value = i;
    }
    for (const mark of marks) { mark.location = data.x[i]; mark.visible = true; }
    if (!keepAddress) history.replaceState(null, "", `#frame-${data.frame[i]}`);
  }

  function follow() {
    const match = /^#frame-(\d+)$/.exec(location.hash);
    if (!match) return false;
    show(nearest(all, i => Math.abs(data.frame[i] - Number(match[1]))), true);
    return true;
  }

  function step(direction) {
    const further = pictured.filter(i => direction * (i - shown) > 0);
    if (further.length) show(nearest(further, i => Math.abs(i - shown)));
  }

  if (byId("cover")) {
    const cover = byId("cover"), slider = byId("slider");
    const pick = event => {
      const box = cover.getBoundingClientRect(), [start, end] = data.range;
      show(at(start + (end - start) * (event.clientX - box.left) / box.width));
    };
    cover.addEventListener("click", pick);
    cover.addEventListener("pointermove", event => {
      if (event.buttons) pick(event);
      cover.title = [...document.querySelectorAll(".strip")].map(strip => {
        const box = strip.getBoundingClientRect();
        if (event.clientY < box.top - 2 || event.clientY > box.bottom + 2) return "";
        const x = 100 * (event.clientX - box.left) / box.width;
        const rect = [...strip.children].find(each => x < Number(each.getAttribute("x")) + Number(each.getAttribute("width")));
        return rect ? rect.textContent : "";
      }).join("");
    });
    slider.max = count - 1;
    slider.addEventListener("input", () => show(Number(slider.value)));
    byId("back").addEventListener("click", () => step(-1));
    byId("on").addEventListener("click", () => step(1));
    addEventListener("keydown", event => {
      if (event.target instanceof HTMLInputElement || event.altKey || event.ctrlKey || event.metaKey) return;
      if (event.key === "ArrowLeft") step(-1);
      if (event.key === "ArrowRight") step(1);
    });
  }
  addEventListener("hashchange", () => {
    if (follow()) byId("timeline").scrollIntoView();
  });

  async function draw() {
    for (const [name, item] of Object.entries(plots)) {
      const views = await Bokeh.embed.embed_item(item, `plot-${name}`);
      const view = [...views][0] ?? views;
      for (const span of view.model.select({type: "Span"})) if (span.name === "now") marks.push(span);
      for (const plot of view.model.select({type: "Figure"})) plot.on_event("tap", event => show(at(event.x)));
    }
    show(shown, true);
  }

  if (!follow()) show(pictured.length ? pictured[Math.floor(pictured.length / 2)] : 0, true);
  if (Object.keys(plots).length) draw();
})();
