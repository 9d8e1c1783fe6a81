// The page of a run: asks for what is new, and shows it.

import { FAILED, Palette, RegionMap, STATES, drawCross, rampColour } from "./map.js";
import { amount, duration, element, memory, showCurve, showFailures, showList, showStages } from "./tables.js";

const BUSY = 1000, IDLE = 5000; // ms between two questions, at work and when it is over
const TITLES = { waiting: "waiting", begun: "some steps done", running: "running", done: "done", reused: "used again", failed: "failed" };
const $ = (id) => document.getElementById(id);
const asked = { stage: "", value: "", view: null, since: 0, key: "" };
let last = null;
let failures = [];
let timer = 0;
let base = 1; // tiles along a cell's side where the whole region is shown

const map = new RegionMap($("map"), { onInspect: inspect, onView: (view) => { if (base > 1) ask({ view }); } });

function ask(change) {
  if (Object.entries(change).every(([name, value]) => String(asked[name]) === String(value))) return;
  Object.assign(asked, change);
  poll();
}

let number = 0;
async function poll() {
  clearTimeout(timer);
  const mine = ++number;
  const words = new URLSearchParams({ stage: asked.stage, value: asked.value, since: asked.since, key: asked.key });
  if (asked.view) words.set("view", asked.view.join(","));
  let answer;
  try {
    const reply = await fetch(`api/state?${words}`);
    if (!reply.ok) throw new Error(`the server says ${reply.status}`);
    answer = await reply.json();
  } catch (error) {
    answer = { gone: String(error.message || error) };
  }
  if (mine !== number) return;
  if (answer.gone || answer.trouble) trouble(answer.trouble || `No answer (${answer.gone}): the run has ended, or its server has. What is shown is what was known last.`);
  else show(answer);
  const running = !answer.head || answer.head.status === "running" || answer.read < 1;
  if (!document.hidden) timer = setTimeout(poll, answer.read < 1 ? 50 : running ? BUSY : IDLE);
}

function trouble(text) {
  $("trouble").hidden = !text;
  $("trouble").textContent = text || "";
}

function show(answer) {
  last = answer;
  asked.since = answer.version;
  asked.key = answer.map.key;
  if (answer.failures) failures = answer.failures;
  if (!asked.view) base = answer.map.level;
  if (answer.map.whole && answer.map.seam_range !== undefined) last.seamRange = show.seamRange = answer.map.seam_range;
  map.setScale(asked.value ? answer.map.range : null, asked.value ? show.seamRange : null);
  map.take(answer.map);
  showHead(answer);
  showChoices(answer);
  showLegend(answer.map.tiles);
  showScale(answer.map);
  showStages($("stages").tBodies[0], answer.stages, asked.stage, (name) => choose(name === asked.stage ? "" : name));
  showTime(answer);
  showTrouble(answer);
  document.body.dataset.version = answer.version;
  window.citystitch.read = answer.read;
}

function showHead({ head, read, dask }) {
  $("status").textContent = { running: "running", dead: "dead: its process is gone" }[head.status] || head.status;
  $("status").dataset.state = head.status;
  const share = 100 * head.share;
  const facts = head.status === "running" ? [`${Math.floor(share)} %`, duration(head.seconds)] : [duration(head.seconds)];
  if (head.status === "running") facts.push(head.left != null ? `~${duration(head.left)} left` : "time left not known yet");
  if (head.workers) facts.push(head.workers === 1 ? "1 worker" : `${head.workers} workers`);
  if (head.crs) facts.push(head.crs.length < 40 ? head.crs : "own CRS");
  if (head.n_notes) facts.push(`${amount(head.n_notes)} notes`);
  if (head.ignored) facts.push(`${amount(head.ignored)} events not understood`);
  if (read < 1) facts.push(`reading, ${Math.floor(100 * read)} % so far`);
  $("facts").textContent = facts.join(" · ");
  $("overall").firstElementChild.style.width = `${share}%`;
  $("overall").setAttribute("aria-valuenow", share.toFixed(0));
  $("dask").hidden = !dask;
  $("command").textContent = head.command || "not known";
  document.title = `${head.status === "running" ? `${Math.floor(share)} %` : head.status} · citystitch`;
  trouble(head.error);
}

function fill(select, options) {
  if (select.options.length === options.length && options.every(([value], k) => select.options[k].value === value)) return;
  const chosen = select.value;
  select.replaceChildren(...options.map(([value, text]) => element("option", { value, text })));
  select.value = chosen;
}

function showChoices({ stages, values }) {
  fill($("value"), [["", "state"], ...values]);
  const there = stages.filter((stage) => stage.mapped);
  fill($("stage"), [["", "all steps"], ...there.map((stage) => [stage.name, stage.name])]);
}

function choose(stage) {
  $("stage").value = stage;
  if ($("stage").value !== stage) $("stage").value = "";
  ask({ stage: $("stage").value });
  if (last) showFailed();
}

function swatch(canvas, code) {
  const pen = canvas.getContext("2d");
  const palette = new Palette(pen);
  pen.clearRect(0, 0, 18, 18);
  if (code === FAILED) return drawCross(pen, palette, 0, 0, 18);
  pen.fillStyle = palette.fill[code];
  pen.fillRect(0, 0, 18, 18);
  pen.strokeStyle = palette.edge;
  pen.strokeRect(0.5, 0.5, 17, 17);
}

function showLegend(tiles) {
  if (!$("legend").children.length) STATES.forEach((state, code) => {
    const button = element("button", { type: "button", "aria-pressed": "true" }, element("canvas", { width: 18, height: 18, "aria-hidden": "true" }), element("span", { text: TITLES[state] }), element("b"));
    button.dataset.state = state;
    button.addEventListener("click", () => {
      const off = !map.hidden.has(code);
      if (off) map.hidden.add(code); else map.hidden.delete(code);
      button.setAttribute("aria-pressed", String(!off));
      map.redraw();
    });
    $("legend").append(button);
    swatch(button.firstChild, code);
  });
  STATES.forEach((state, code) => {
    const button = $("legend").children[code];
    button.dataset.count = tiles[code];
    button.lastChild.textContent = amount(tiles[code]);
  });
}

function showScale({ range, level }) {
  $("hint").textContent = level > 1 ? `squares of ${level} × ${level} tiles; zoom in for tiles and seams`
    : map.seams.boxes.length && !map.seamsShown ? "zoom in for seams" : "";
  $("scale").hidden = !asked.value || !range;
  if ($("scale").hidden) return;
  $("low").textContent = amount(range[0]);
  $("high").textContent = amount(range[1]);
  const title = $("value").selectedOptions[0]?.textContent || "";
  $("unit").textContent = title + (map.scale?.byMagnitude ? ", by magnitude" : "");
  const pen = $("ramp").getContext("2d");
  for (let k = 0; k < 256; k++) { pen.fillStyle = rampColour(k / 255); pen.fillRect(k, 0, 1, 10); }
}

function showTime({ series, head, at_work: atWork }) {
  const seconds = series.width * series.rows.length;
  showCurve($("rate"), $("c-rate"), "Tasks a minute", series.rows.map(([done]) => (60 * done) / series.width), { tell: (value) => amount(Math.round(value)), seconds });
  showCurve($("memory"), $("c-memory"), "Largest worker process", series.rows.map((row) => row[2]), { tell: memory, seconds });
  const lines = atWork.map(([stage, name, since]) => `${stage} ${name}, ${duration(since)}`);
  $("h-work").textContent = head.status === "dead" ? "Running when it died" : "Running now";
  showList($("work"), lines.length ? lines : [head.status === "running" ? "Nothing yet." : "Nothing: the run is over."]);
}

function showTrouble(answer) {
  if (answer.failures) showFailed();
  if (answer.messages) showList($("messages"), answer.messages.map(([, text]) => text));
  showList($("notes"), answer.head.notes);
}

function showFailed() {
  const chosen = failures.filter((one) => !asked.stage || one.step === asked.stage);
  const all = last.n_failures;
  $("h-failures").textContent = all ? `Failures (${amount(all)})` : "Failures";
  $("no-failures").hidden = chosen.length > 0;
  $("no-failures").textContent = all ? `None in ${asked.stage}.` : "None.";
  $("failures").hidden = !chosen.length;
  showFailures($("failures").tBodies[0], chosen, (name) => {
    const index = map.tiles.names.indexOf(name);
    if (index >= 0) { map.select(index); $("map").focus(); }
  });
}

function inspect({ layer, index }) {
  const found = map[layer];
  const code = found.codes[index] || 0;
  const words = [];
  const tally = found.tallies[index];
  if (tally) {
    words.push(`${amount(tally.reduce((sum, n) => sum + n, 0))} tiles`);
    tally.forEach((n, k) => { if (n) words.push(`${amount(n)} ${TITLES[STATES[k]]}`); });
  } else words.push(`${layer === "tiles" ? "Tile" : "Seam"} ${found.names[index]}`, TITLES[STATES[code]]);
  if (asked.value && found.values[index] != null) words.push(`${amount(found.values[index])} ${$("value").selectedOptions[0].textContent}`);
  const why = failures.find((one) => one.name === found.names[index]);
  if (why) words.push(`${why.title}: ${why.reason}`);
  $("inspect").textContent = words.join(" · ");
}

$("value").addEventListener("change", () => ask({ value: $("value").value }));
$("stage").addEventListener("change", () => choose($("stage").value));
$("controls").addEventListener("submit", (event) => event.preventDefault());
$("closer").addEventListener("click", () => map.zoomBy(1.6));
$("wider").addEventListener("click", () => map.zoomBy(1 / 1.6));
$("fit").addEventListener("click", () => map.fit());
function retheme() {
  map.retheme();
  [...$("legend").children].forEach((button, code) => swatch(button.firstChild, code));
}
$("theme").addEventListener("click", () => {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
  retheme();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", retheme);
document.addEventListener("visibilitychange", () => { if (!document.hidden) poll(); });
window.citystitch = { map, asked };
poll();
