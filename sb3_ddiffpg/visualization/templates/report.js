// What the page does: choose modes, step through episodes, compare, and ask for news of a run.
"use strict";

(() => {
  const OPTIONS = {displayModeBar: false, scrollZoom: false, doubleClick: false};
  const find = (selector, within = document) => within.querySelector(selector);
  const every = (selector, within = document) => [...within.querySelectorAll(selector)];
  const live = document.body.dataset.live === "yes";
  let models = JSON.parse(find("#data").textContent);
  // What each panel shows: "model/mode", the second null where nothing is compared; and which episode, null: all
  const state = [{key: null, episode: null, view: 1}, {key: null, episode: null, view: 1}];

  // ------------------------------------------------------------------ drawing

  // A chart is as wide as its place, also when another panel takes half of it
  const sizes = new ResizeObserver((changes) => changes.forEach(({target}) => target.data && target.offsetWidth && Plotly.Plots.resize(target)));

  function draw(element, chart, said) {
    element.hidden = !chart;
    const title = element.previousElementSibling;
    if (title?.tagName === "H4") title.hidden = !chart;
    if (!chart) return undefined;
    element.setAttribute("aria-label", said);
    if (chart.height) element.style.height = `${chart.height}px`;
    const drawn = Plotly.react(element, chart.traces, chart.layout, OPTIONS);
    sizes.observe(element);
    return drawn;
  }

  function parse(key) {
    const [model, mode] = key.split("/").map(Number);
    return {model: models[model], index: mode, mode: models[model].modes[mode], number: model};
  }

  function title({model, mode}) {
    return models.length > 1 ? `${mode.name} of ${model.label}` : mode.name;
  }

  function drawPaths(side) {
    const {key, episode, view} = state[side], shown = parse(key), {model, index, mode} = shown;
    const panel = find("#panels").children[side], episodes = mode.episodes ?? [];
    const reached = episodes.filter((each) => each.ok !== false).length;
    const all = episodes.length ? `All: ${reached} of ${episodes.length} episodes reached the goal. Dashed: it was not reached.` : "The central path of its trajectories.";
    const said = episode === null ? all : charts.episodeText(episodes[episode], episode, episodes.length);
    draw(find(".paths", panel), charts.paths(model, [index], view, episode), `Paths of ${title(shown)}. ${said}`);
    find(".said", panel).textContent = said;
    const slider = find(".episode input", panel);
    slider.value = episode === null ? 0 : episode + 1;
    slider.setAttribute("aria-valuetext", said);
  }

  function choose(side, episode) {
    if (state[side].episode === episode) return;
    state[side].episode = episode;
    drawPaths(side);
  }

  function newPanel(side) {
    const panel = find("#panel").content.firstElementChild.cloneNode(true);
    find("#panels").append(panel);
    find(".episode input", panel).addEventListener("input", (event) => choose(side, event.target.value === "0" ? null : event.target.value - 1));
    find(".view select", panel).addEventListener("change", (event) => {
      state[side].view = Number(event.target.value);
      drawPaths(side);
    });
    return panel;
  }

  function listen(side, panel) {
    const paths = find(".paths", panel), values = find(".values", panel), video = find("video", panel);
    if (paths.listening) return;
    paths.listening = true;
    const pick = (event) => {
      const id = event.points[0]?.customdata;
      if (typeof id === "number") choose(side, id);
    };
    paths.on("plotly_hover", pick);
    paths.on("plotly_click", pick);
    // The film goes to the step under the pointer
    values.on?.("plotly_hover", (event) => {
      if (video.src && video.dataset.rate) video.currentTime = event.points[0].x / video.dataset.rate;
    });
  }

  function drawPanel(side) {
    const shown = parse(state[side].key), {model, index, mode, number} = shown;
    const panel = find("#panels").children[side] ?? newPanel(side), name = title(shown);
    const episodes = mode.episodes ?? [];
    if (state[side].episode !== null && state[side].episode >= episodes.length) state[side].episode = null;
    find("h3", panel).textContent = name;
    find(".facts", panel).textContent = mode.facts ?? `Success in training ${charts.percent(mode.success_rate)}; ${mode.n_trajectories} trajectories; known since step ${charts.count(mode.born_at)}`;
    find(".episode", panel).hidden = !episodes.length;
    const slider = find(".episode input", panel);
    slider.max = episodes.length;
    slider.setAttribute("aria-label", `Episode of ${name}, 0: all`);
    find(".view", panel).hidden = model.components.length < 3;
    drawPaths(side);
    draw(find(".starts", panel), charts.starts(model, index), `Where episodes of ${name} began, and whether they reached the goal. ${mode.starts?.said ?? ""}`);
    find(".told", panel).textContent = mode.starts?.said ?? "";
    draw(find(".values", panel), charts.values(model, index), `What the critics expect along an episode of ${name}`);
    draw(find(".history", panel), charts.history(model, index), `Success of ${name} in training`);
    const video = find("video", panel);
    const film = every("#texts video").find((each) => each.dataset.film === `${number}/${mode.name}`);
    video.hidden = !film;
    if (film && video.dataset.shows !== film.dataset.film) {
      Object.assign(video.dataset, {shows: film.dataset.film, rate: mode.rate ?? ""});
      video.src = film.src;
      video.setAttribute("aria-label", `Film of ${name}`);
    }
    const life = model.lives.find((each) => each.number === mode.number);
    const names = new Set([mode.name, life?.name]), told = model.events.filter(([, text]) => [...names].some((each) => each && ` ${text} `.includes(` ${each} `)));
    find(".events", panel).replaceChildren(...told.map(([step, text]) => {
      const item = document.createElement("li");
      item.textContent = `step ${charts.count(step)}: ${text}`;
      return item;
    }));
    listen(side, panel);
  }

  function drawOverview() {
    const kinds = {
      paths: (model) => (model.modes.length ? charts.paths(model, model.modes.map((_, index) => index)) : null),
      timeline: charts.timeline, history: (model) => charts.history(model, null), coverage: charts.coverage, tests: charts.tests,
    };
    const words = {
      paths: "Paths of all modes", timeline: "Modes born and lost", history: "Success of each mode in training",
      coverage: "How much of the space was known when", tests: "Tests along the way",
    };
    // All places first: a chart takes the width that its place has when it is drawn
    const asked = models.flatMap((model, number) => Object.entries(kinds).map(([kind, make]) => {
      const chart = make(model), id = `${kind}-${number}`, said = words[kind] + (models.length > 1 ? ` of ${model.label}` : "");
      return {kind, number, chart, said, element: document.getElementById(id) ?? (chart ? newChart(id, said) : null)};
    }));
    find("#all").hidden = !find("#overview").children.length;
    for (const {kind, number, chart, said, element} of asked) {
      if (!element) continue;
      draw(element, chart, said);
      if (kind !== "paths" || !chart || element.listening) continue;
      element.listening = true;
      element.on("plotly_click", (event) => show(0, `${number}/${event.points[0].data.meta}`));
    }
  }

  function newChart(id, said) {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    const element = Object.assign(document.createElement("div"), {id, className: "chart"});
    element.setAttribute("role", "img");
    caption.textContent = said;
    figure.append(caption, element);
    find("#overview").append(figure);
    return element;
  }

  // ------------------------------------------------------------------ choosing

  function fillSelects() {
    for (const [id, first] of [["#shown", null], ["#beside", "nothing"]]) {
      const select = find(id);
      select.replaceChildren(...(first === null ? [] : [new Option(first, "")]));
      models.forEach((model, number) => {
        const group = Object.assign(document.createElement("optgroup"), {label: model.label});
        group.append(...model.modes.map((mode, index) => new Option(models.length > 1 ? `${mode.name} of ${model.label}` : mode.name, `${number}/${index}`)));
        if (model.modes.length) select.append(group);
      });
    }
  }

  function show(side, key) {
    if (state[side].key !== key) Object.assign(state[side], {key, episode: null});
    render();
  }

  function render() {
    const keys = models.flatMap((model, number) => model.modes.map((_, index) => `${number}/${index}`));
    find("#close").hidden = !keys.length;
    if (keys.length) {
      if (!keys.includes(state[0].key)) {
        const first = find("button.mode");
        state[0].key = `${first.dataset.model}/${first.dataset.mode}`;
      }
      if (!keys.includes(state[1].key)) state[1].key = null;
      find("#shown").value = state[0].key;
      find("#beside").value = state[1].key ?? "";
      find("#panels").classList.toggle("two", state[1].key !== null);
      if (state[1].key === null) find("#panels").children[1]?.remove();
      drawPanel(0);
      if (state[1].key !== null) drawPanel(1);
    }
    every("button.mode").forEach((button) => {
      button.setAttribute("aria-pressed", state.some(({key}) => key === `${button.dataset.model}/${button.dataset.mode}`));
    });
  }

  // ------------------------------------------------------------------ a run in progress

  function keepKeys(before) {
    // The same mode may have another place now: it is known by its model's label and its number
    for (const each of state) {
      if (each.key === null) continue;
      const [model, mode] = each.key.split("/").map(Number), number = before[model]?.modes[mode]?.number;
      const place = models.findIndex((other) => other.label === before[model]?.label);
      const index = place < 0 ? -1 : models[place].modes.findIndex((other) => other.number === number);
      each.key = index < 0 ? null : `${place}/${index}`;
    }
  }

  async function refresh() {
    try {
      const answer = await fetch("/now", {cache: "no-store"});
      if (!answer.ok) throw new Error(answer.statusText);
      const news = new DOMParser().parseFromString(await answer.text(), "text/html"), text = find("#data", news).textContent;
      if (text !== find("#data").textContent) {
        const before = models, button = document.activeElement?.closest?.("button.mode"), open = every("details").map((each) => each.open);
        models = JSON.parse(text);
        find("#data").textContent = text;
        for (const id of ["#models", "#texts"]) find(id).replaceChildren(...find(id, news).childNodes);
        every("details").forEach((each, index) => (each.open = open[index] ?? each.open));
        keepKeys(before);
        fillSelects();
        render();
        drawOverview();
        if (button) find(`button.mode[data-model="${button.dataset.model}"][data-mode="${button.dataset.mode}"]`)?.focus();
      }
      find("#state").textContent = `As of ${new Date().toLocaleTimeString()}; the page asks for news by itself.`;
    } catch {
      find("#state").textContent = "The server does not answer: has ddiffpg watch ended? The page shows what was known before.";
    }
  }

  // ------------------------------------------------------------------ begin

  async function loadLibrary() {
    const packed = Uint8Array.from(atob(find("#library").textContent), (each) => each.charCodeAt(0));
    const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(unpacked).text();
    document.head.append(script);
    find("#library").remove();
  }

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button.mode");
    if (button) show(0, `${button.dataset.model}/${button.dataset.mode}`);
  });
  find("#shown").addEventListener("change", (event) => show(0, event.target.value));
  find("#beside").addEventListener("change", (event) => show(1, event.target.value || null));

  loadLibrary().then(() => {
    fillSelects();
    render();
    document.body.dataset.ready = Math.round(performance.now());
    setTimeout(() => {
      drawOverview();
      document.body.dataset.drawn = Math.round(performance.now());
      if (live) {
        refresh();
        setInterval(refresh, 3000);
      }
    });
  }).catch((error) => {
    find("#state").textContent = `The charts cannot be drawn (${error.message}): tables and pictures below are all there is.`;
  });
})();
