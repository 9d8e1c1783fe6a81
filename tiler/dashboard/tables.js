// Tables, lists and curves of the page. Everything that a run tells goes in as text, never as HTML.

const SVG = "http://www.w3.org/2000/svg";

export function element(tag, { text, className, ...rest } = {}, ...children) {
  const made = document.createElement(tag);
  if (text != null) made.textContent = text;
  if (className) made.className = className;
  for (const [name, value] of Object.entries(rest)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

export function duration(seconds) {
  if (seconds < 9.95) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172800) return `${(seconds / 3600).toFixed(1)} h`;
  return `${(seconds / 86400).toFixed(1)} d`;
}

export function amount(value) {
  if (value == null) return "–";
  if (Number.isInteger(value)) return value.toLocaleString("en");
  return Math.abs(value) >= 1000 ? Math.round(value).toLocaleString("en") : String(Number(value.toPrecision(3)));
}

export function memory(bytes) {
  return bytes >= 2 ** 30 ? `${(bytes / 2 ** 30).toFixed(1)} GiB` : `${Math.round(bytes / 2 ** 20)} MiB`;
}

// Rows are kept and changed in place, so that the focus stays where it is.
export function showStages(body, stages, chosen, choose) {
  const rows = new Map([...body.rows].map((row) => [row.dataset.stage, row]));
  for (const stage of stages) {
    let row = rows.get(stage.name);
    if (!row) {
      const bar = element("div", { className: "bar" }, ...["done", "reused", "running", "failed"].map((kind) => element("i", { className: kind })));
      row = element("tr", {}, element("td", {}, element("button", { type: "button", text: stage.name, onclick: () => choose(stage.name) })), element("td", {}, bar), element("td"), element("td"), element("td"));
      row.dataset.stage = stage.name;
      body.append(row);
    }
    const [, bar, done, total, time] = row.cells;
    const counts = { done: stage.done - stage.reused, reused: stage.reused, running: stage.running, failed: stage.failed };
    for (const part of bar.firstChild.children) part.hidden = !counts[part.className];
    for (const part of bar.firstChild.children) part.style.width = `${(100 * counts[part.className]) / Math.max(stage.total, 1)}%`;
    const said = `${stage.done} of ${stage.total} done, ${stage.reused} used again, ${stage.running} running, ${stage.failed} failed`;
    bar.firstChild.title = said;
    bar.firstChild.setAttribute("role", "img");
    bar.firstChild.setAttribute("aria-label", said);
    done.textContent = amount(stage.done) + (stage.failed ? ` (${amount(stage.failed)} ×)` : "");
    total.textContent = amount(stage.total);
    time.textContent = stage.seconds ? duration(stage.seconds) : "";
    row.setAttribute("aria-current", String(stage.name === chosen));
  }
  const names = new Set(stages.map((stage) => stage.name));
  for (const [name, row] of rows) if (!names.has(name)) row.remove();
}

export function showFailures(body, failures, locate) {
  body.replaceChildren(...failures.map((one) => {
    const command = element("td");
    if (one.command) {
      const copy = element("button", { type: "button", text: "copy", "aria-label": `Copy the command for ${one.name}` });
      copy.addEventListener("click", () => navigator.clipboard?.writeText(one.command).then(() => { copy.textContent = "copied"; }, () => { copy.textContent = "select it"; }));
      command.append(element("code", { text: one.command }), " ", copy);
    } else command.textContent = "no command of its own";
    return element("tr", {},
      element("td", {}, element("button", { type: "button", text: `${one.title} ${one.name}`, onclick: () => locate(one.name) })),
      element("td", { text: one.reason }), command);
  }));
}

export function showList(list, lines) {
  const known = [...list.children].map((item) => item.textContent);
  if (known.length === lines.length && lines.every((line, k) => line === known[k])) return;
  list.replaceChildren(...lines.map((text) => element("li", { text })));
}

// A curve over time: numbers in equal intervals, drawn as an area, with the largest value and the time told.
export function showCurve(svg, caption, title, numbers, { tell, seconds }) {
  const [width, height, top, bottom] = [svg.clientWidth || 300, svg.clientHeight || 90, 16, 16];
  const most = Math.max(...numbers, 0);
  const make = (tag, given, text) => {
    const made = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(given)) made.setAttribute(name, value);
    if (text != null) made.textContent = text;
    return made;
  };
  const x = (k) => (numbers.length > 1 ? (k / (numbers.length - 1)) * (width - 2) + 1 : width / 2);
  const y = (value) => height - bottom - (most > 0 ? value / most : 0) * (height - top - bottom);
  const points = numbers.map((value, k) => `${x(k).toFixed(1)},${y(value).toFixed(1)}`);
  const floor = height - bottom;
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.replaceChildren(
    make("line", { class: "axis", x1: 0, x2: width, y1: floor, y2: floor }),
    ...(points.length ? [make("polygon", { class: "area", points: `${x(0)},${floor} ${points.join(" ")} ${x(numbers.length - 1)},${floor}` })] : []),
    make("text", { x: 2, y: 11 }, `at most ${tell(most)}`),
    make("text", { x: 2, y: height - 3 }, "start"),
    make("text", { x: width - 2, y: height - 3, "text-anchor": "end" }, duration(seconds)),
  );
  const last = numbers.length ? numbers[numbers.length - 1] : 0;
  caption.textContent = `${title}: ${tell(last)} now`;
}
