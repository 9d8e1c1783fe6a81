// Opens the page of a run in headless Chromium, goes through it as a user would, and prints what it saw as JSON.
// node browse.js URL CHROMIUM FOLDER: screenshots go into the folder. NODE_PATH tells where playwright-core is.
const { chromium } = require("playwright-core");

const [url, executablePath, folder] = process.argv.slice(2);
const seen = { console: [], foreign: [] };

async function open(browser, width, height, colorScheme) {
  const context = await browser.newContext({ viewport: { width, height }, colorScheme });
  const page = await context.newPage();
  page.on("console", (message) => { if (["error", "warning"].includes(message.type())) seen.console.push(message.text()); });
  page.on("pageerror", (error) => seen.console.push(String(error)));
  page.on("request", (request) => { if (!request.url().startsWith(new URL(url).origin) && !request.url().startsWith("data:")) seen.foreign.push(request.url()); });
  page.on("dialog", (dialog) => { seen.console.push(`dialog ${dialog.message()}`); dialog.dismiss(); });
  await page.goto(url);
  await page.waitForFunction(() => document.body.dataset.firstDraw && window.citystitch.read === 1, null, { timeout: 120000 });
  await page.evaluate(() => new Promise((next) => requestAnimationFrame(() => requestAnimationFrame(next))));
  return page;
}

const drawn = (page) => page.evaluate(() => new Promise((next) => requestAnimationFrame(() => requestAnimationFrame(() => next(JSON.parse(document.getElementById("map").dataset.drawn))))));
const legend = (page) => page.$$eval("#legend button", (all) => Object.fromEntries(all.map((one) => [one.dataset.state, Number(one.dataset.count)])));
const text = (page, selector) => page.$eval(selector, (one) => one.textContent);
const overflows = (page) => page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);

// Colour of the canvas in the middle of a tile.
const colourAt = (page, name) => page.evaluate((wanted) => {
  const { map } = window.citystitch;
  const [xmin, ymin, xmax, ymax] = map.tiles.boxes[map.tiles.names.indexOf(wanted)];
  const { k, left, top } = map.frame();
  const ratio = window.devicePixelRatio;
  const [x, y] = [((xmin + 0.3 * (xmax - xmin)) - left) * k, (top - (ymin + 0.5 * (ymax - ymin))) * k];
  const copy = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  copy.drawImage(map.canvas, Math.round(x * ratio), Math.round(y * ratio), 1, 1, 0, 0, 1, 1);
  return [...copy.getImageData(0, 0, 1, 1).data].slice(0, 3);
}, name);

(async () => {
  const browser = await chromium.launch({ executablePath, args: ["--no-sandbox"] });
  try {
    const page = await open(browser, 1280, 800, "light");
    seen.legend = await legend(page);
    seen.drawn = await drawn(page);
    seen.title = await page.title();
    seen.failures = await page.$$eval("#failures tbody tr", (rows) => rows.map((row) => [...row.cells].map((cell) => cell.textContent)));
    seen.images = await page.$$eval("img, script:not([src])", (all) => all.length);
    seen.colours = { failed: await colourAt(page, "1_0"), done: await colourAt(page, "5_0") };
    await page.screenshot({ path: `${folder}/desktop.png`, fullPage: true });
    await page.click('#legend button[data-state="done"]');
    seen.withoutDone = await drawn(page);
    await page.click('#legend button[data-state="done"]');
    await page.selectOption("#stage", "terrain");
    await page.waitForFunction(() => document.querySelector('#legend button[data-state="failed"]').dataset.count === "0");
    seen.ground = await legend(page);
    seen.failuresOfGround = await text(page, "#no-failures");
    await page.selectOption("#stage", "");
    await page.waitForFunction(() => document.querySelector('#legend button[data-state="failed"]').dataset.count !== "0");
    await page.selectOption("#value", "cells");
    await page.waitForFunction(() => !document.getElementById("scale").hidden);
    seen.scale = [await text(page, "#low"), await text(page, "#high")];
    seen.valueColour = await colourAt(page, "5_0");
    await page.selectOption("#value", "");
    // Keys alone: everything that can be pressed is reached by Tab, and shows that it is.
    await page.focus(".skip");
    seen.tabs = [];
    for (let k = 0; k < 60; k++) {
      await page.keyboard.press("Tab");
      const found = await page.evaluate(() => { const one = document.activeElement; return one === document.body ? null : [one.id || one.dataset.state || one.textContent, getComputedStyle(one).outlineStyle]; });
      if (!found) break;
      seen.tabs.push(found);
    }
    await page.focus("#map");
    await page.keyboard.press("ArrowRight");
    const first = await text(page, "#inspect");
    await page.keyboard.press("ArrowRight");
    await page.keyboard.press("ArrowDown");
    seen.keys = [first, await text(page, "#inspect")];
    await page.keyboard.press("f");
    seen.keyFailed = await text(page, "#inspect");
    await page.keyboard.press("+");
    await page.keyboard.press("+");
    seen.zoom = await page.evaluate(() => window.citystitch.map.zoom);
    await page.keyboard.press("0");
    const phone = await open(browser, 390, 844, "dark");
    seen.phoneOverflow = await overflows(phone);
    seen.phoneSmall = await phone.$$eval("button, select", (all) => all.filter((one) => one.offsetHeight && one.offsetHeight < 30).map((one) => one.textContent));
    await phone.screenshot({ path: `${folder}/phone.png`, fullPage: true });
    // The run goes on: what is new appears by itself.
    await page.bringToFront();
    console.log("ready");
    await page.waitForFunction(() => Number(document.querySelector('#legend button[data-state="failed"]').dataset.count) === 4, null, { timeout: 30000 });
    seen.later = await legend(page);
    seen.failuresLater = await page.$$eval("#failures tbody tr", (rows) => rows.length);
  } finally {
    await browser.close();
  }
  console.log(JSON.stringify(seen));
})().catch((error) => { console.log(JSON.stringify({ ...seen, error: String(error) })); process.exit(1); });
