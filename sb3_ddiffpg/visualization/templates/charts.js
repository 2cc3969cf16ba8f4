// What Plotly draws: each function makes traces and a layout of what the page knows. Nothing here touches the page.
"use strict";

const charts = (() => {
  const FAILED = "dash", DARK = "#222222";
  const CAME = "circle-open", WENT = "x-thin-open";

  // Plotly reads some HTML in texts
  const plain = (text) => String(text).replace(/[&<>]/g, (each) => ({"&": "&amp;", "<": "&lt;", ">": "&gt;"})[each]);
  const percent = (share) => (share === null || share === undefined ? "unknown" : `${Math.round(100 * share)} %`);
  const count = (n) => n.toLocaleString("en");

  function layout(x, y, more = {}) {
    const axis = {zeroline: false, gridcolor: "#e8e8e8", automargin: true, fixedrange: true};
    return {
      margin: {l: 45, r: 10, t: 10, b: 40}, hovermode: "closest", dragmode: false, showlegend: false, font: {size: 12},
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", hoverlabel: {bgcolor: "#fff", font: {color: DARK}},
      ...more, xaxis: {...axis, title: {text: plain(x)}, ...more.xaxis}, yaxis: {...axis, title: {text: plain(y)}, ...more.yaxis},
    };
  }

  const legend = {orientation: "h", yanchor: "bottom", y: 1.02, x: 0, itemsizing: "constant"};

  function episodeText(episode, index, total) {
    const came = episode.ok === null ? "nobody says whether it succeeded" : episode.ok ? "success" : "failure";
    const route = episode.route ? `, route ${episode.route}` : "";
    return `Episode ${index + 1} of ${total}: ${came}, ${episode.length} steps, return ${episode.ret}${route}`;
  }

  function mazeShapes(maze) {
    if (!maze) return [];
    const below = {layer: "below", line: {width: 0}};
    const walls = maze.walls.map(([x0, y0, x1, y1]) => ({...below, type: "rect", x0, y0, x1, y1, fillcolor: "#b5b5b5"}));
    const goals = maze.goals.map(([x, y]) => ({
      type: "circle", x0: x - 1, x1: x + 1, y0: y - 1, y1: y + 1, layer: "below", fillcolor: "#fff3b0", line: {color: DARK, width: 1},
    }));
    return [...walls, ...goals];
  }

  // Coordinates of some paths one after the other, with a gap behind each
  function joined(paths, ids, parts) {
    const found = {x: [], y: [], customdata: []};
    paths.forEach((path, at) => {
      const [first, second] = parts.map((part) => path[part] ?? path[0].map(() => 0));
      found.x.push(...first, null);
      found.y.push(...second, null);
      found.customdata.push(...first.map(() => ids[at]), null);
    });
    return found;
  }

  // Paths of some modes of a model. `chosen`: an episode of the first one that is drawn over the others
  function paths(model, indices, view = 1, chosen = null) {
    const parts = [0, view], traces = [], limits = model.maze?.extent;
    for (const index of indices) {
      const mode = model.modes[index], look = model.looks[mode.number], episodes = mode.episodes ?? [];
      for (const ok of [true, false]) {
        const ids = episodes.map((_, id) => id).filter((id) => (episodes[id].ok !== false) === ok);
        if (!ids.length) continue;
        const line = joined(ids.map((id) => episodes[id].path), ids, parts);
        const told = episodes.map((each, id) => plain(`${mode.name}. ${episodeText(each, id, episodes.length)}`));
        const text = line.customdata.map((id) => (id === null ? "" : told[id]));
        traces.push({
          ...line, text, mode: "lines", type: "scatter", name: plain(mode.name), meta: index, hovertemplate: "%{text}<extra></extra>",
          line: {color: look.color, width: 1.2, dash: ok ? "solid" : FAILED}, opacity: chosen === null ? 0.6 : 0.2, showlegend: false,
        });
      }
      if (mode.route.length) {
        const x = mode.route[0], y = mode.route[parts[1]] ?? x.map(() => 0);
        const own = {x, y, type: "scatter", meta: index, hoverinfo: episodes.length ? "skip" : "name", name: plain(mode.name)};
        traces.push({...own, mode: "lines", line: {color: DARK, width: 4.5}, showlegend: false, hoverinfo: "skip"});
        const size = x.map((_, at) => (at === x.length - 1 ? 12 : 0));
        traces.push({
          ...own, mode: "lines+markers", line: {color: look.color, width: 3},
          marker: {symbol: look.symbol, size, color: look.color, opacity: 1, line: {color: DARK, width: 1}}, showlegend: false,
        });
      }
      traces.push({
        x: [null], y: [null], type: "scatter", mode: "lines+markers", name: plain(mode.name), meta: index,
        line: {color: look.color, width: 3}, marker: {symbol: look.symbol, size: 10, color: look.color, line: {color: DARK, width: 1}}, showlegend: indices.length > 1,
      });
    }
    const drawn = chosen === null ? null : model.modes[indices[0]].episodes?.[chosen];
    if (drawn) {
      const line = joined([drawn.path], [chosen], parts);
      traces.push({...line, type: "scatter", mode: "lines", line: {color: DARK, width: 3.5, dash: drawn.ok === false ? FAILED : "solid"}, hoverinfo: "skip"});
    }
    const names = [model.components[0] ?? "", model.components[view] ?? ""], alike = model.maze ? {scaleanchor: "x"} : {};
    const annotations = !model.maze ? [] : [
      {x: model.maze.start[0], y: model.maze.start[1], text: "start", showarrow: false, bgcolor: "rgba(255,255,255,.8)", yshift: -14},
      ...model.maze.goals.map(([x, y]) => ({x, y, text: "goal", showarrow: false, bgcolor: "rgba(255,255,255,.8)", yshift: -14})),
    ];
    const ranges = limits ? {
      xaxis: {range: limits.slice(0, 2), constrain: "domain", showgrid: false},
      yaxis: {range: limits.slice(2), constrain: "domain", showgrid: false, ...alike},
    } : {};
    return {traces, layout: layout(...names, {...ranges, shapes: mazeShapes(model.maze), annotations, showlegend: indices.length > 1, legend})};
  }

  // Where episodes began, and whether they reached the goal
  function starts(model, index) {
    const mode = model.modes[index], found = mode.starts, look = model.looks[mode.number];
    if (!found?.x.length) return null;
    const some = (ok) => found.ok.flatMap((each, at) => ((each !== false) === ok ? [at] : []));
    const trace = (ok, name, marker) => ({
      x: some(ok).map((at) => found.x[at]), y: some(ok).map((at) => found.y[at]), type: "scatter", mode: "markers", name, marker,
      hovertemplate: `${name}, start %{x}, %{y}<extra></extra>`,
    });
    const traces = [
      trace(true, "success", {symbol: "circle", size: 9, color: look.color, opacity: 0.8, line: {color: DARK, width: 0.7}}),
      trace(false, "failure", {symbol: "x", size: 9, color: DARK}),
    ];
    return {traces, layout: layout(model.components[0], model.components[1] ?? "", {showlegend: true, legend})};
  }

  // What the critics of each mode expect at each step of an episode of this one
  function values(model, index) {
    const found = model.modes[index].values;
    if (!found?.step.length) return null;
    const traces = model.modes.map((mode, other) => {
      const look = model.looks[mode.number], own = other === index;
      return {
        x: found.step, y: found.value[other], type: "scatter", mode: "lines+markers", name: plain(mode.name), opacity: own ? 1 : 0.55,
        line: {color: look.color, width: own ? 3 : 1.2},
        marker: {symbol: look.symbol, color: look.color, opacity: 1, size: found.step.map((_, at) => (at % 20 === 10 ? 7 : 0)), line: {color: DARK, width: 0.5}},
        hovertemplate: `step %{x}: %{y:.2f} by ${plain(mode.name)}<extra></extra>`,
      };
    });
    traces.push(...traces.splice(index, 1)); // on top
    return {traces, layout: layout("step of the episode", "expected value", {showlegend: traces.length > 1, legend})};
  }

  // Success in training, of one mode or (index null) of all that live
  function history(model, index) {
    const shown = index === null ? model.modes : [model.modes[index]];
    const traces = shown.flatMap((mode) => {
      const course = model.courses.find((each) => each.number === mode.number), look = model.looks[mode.number];
      if (!course) return [];
      const every = Math.max(1, Math.floor(course.step.length / 8));
      return [{
        x: course.step, y: course.success, customdata: course.n_trajectories, type: "scatter", mode: "lines+markers", name: plain(mode.name),
        line: {color: look.color, width: 2},
        marker: {symbol: look.symbol, color: look.color, opacity: 1, size: course.step.map((_, at) => (at % every === 0 ? 8 : 0)), line: {color: DARK, width: 0.5}},
        hovertemplate: `${plain(mode.name)}, step %{x:,}: success %{y:.0%}, %{customdata} trajectories<extra></extra>`,
      }];
    });
    if (!traces.length) return null;
    const yaxis = {range: [-0.03, 1.05], tickformat: ".0%"};
    return {traces, layout: layout("environment steps", "success in training", {showlegend: index === null, legend, yaxis, xaxis: {rangemode: "tozero"}})};
  }

  // When modes were born and lost
  function timeline(model) {
    if (!model.lives.length) return null;
    const traces = model.lives.map((life, row) => {
      const look = model.looks[life.number], end = life.end ?? model.steps, name = plain(life.name);
      const said = [`${name} ${plain(life.came)} at step ${count(life.begin)}`, life.end === null ? `${name} lives at step ${count(model.steps)}` : `${name} ${plain(life.went)} at step ${count(life.end)}`];
      return {
        x: [life.begin, end], y: [row, row], text: said, type: "scatter", mode: "lines+markers", name, hovertemplate: "%{text}<extra></extra>",
        line: {color: look.color, width: 5},
        marker: {symbol: [CAME, life.end === null ? look.symbol : WENT], size: 11, color: life.end === null ? [DARK, look.color] : DARK, line: {color: DARK, width: 2}},
      };
    });
    const names = model.lives.map((life) => plain(life.name));
    const yaxis = {tickvals: names.map((_, row) => row), ticktext: names, range: [names.length - 0.5, -0.5]};
    return {height: Math.max(320, 90 + 20 * names.length), traces, layout: layout("environment steps", "", {yaxis, xaxis: {rangemode: "tozero"}})};
  }

  const curve = (x, y, name, text) => ({x, y, type: "scatter", mode: "lines+markers", name, marker: {size: 5}, hovertemplate: `step %{x:,}: ${text}<extra></extra>`});

  function coverage(model) {
    const [x, y] = model.coverage;
    if (!x.length) return null;
    return {traces: [{...curve(x, y, "cells", "%{y:,} cells"), line: {color: DARK}, marker: {size: 4, color: DARK}}], layout: layout("environment steps", "known cells", {yaxis: {rangemode: "tozero"}, xaxis: {rangemode: "tozero"}})};
  }

  function tests(model) {
    const {step, success, modes} = model.tests;
    if (!step?.length) return null;
    const traces = [
      {...curve(step, success, "success without command", "success %{y:.0%}"), line: {color: "#0072B2"}},
      {...curve(step, modes, "routes by command", "%{y} routes by command"), yaxis: "y2", line: {color: "#D55E00", dash: "dot"}, marker: {symbol: "square", size: 6}},
    ];
    const yaxis2 = {overlaying: "y", side: "right", tickmode: "auto", rangemode: "tozero", automargin: true, fixedrange: true, showgrid: false, title: {text: "routes by command"}};
    return {traces, layout: layout("environment steps", "success", {yaxis: {range: [-0.03, 1.05], tickformat: ".0%"}, yaxis2, showlegend: true, legend, margin: {l: 45, r: 45, t: 10, b: 40}})};
  }

  return {paths, starts, values, history, timeline, coverage, tests, episodeText, percent, count};
})();
