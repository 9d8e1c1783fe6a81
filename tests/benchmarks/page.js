// Times the page of a run in headless Chromium, and prints what it found as JSON: node page.js URL CHROMIUM FOLDER.
const { chromium } = require("playwright-core");

const [url, executablePath, folder] = process.argv.slice(2);
const median = (numbers) => [...numbers].sort((a, b) => a - b)[Math.floor(numbers.length / 2)];

// Move the map for two seconds; gives the time that a drawing takes, and the time between two frames (ms).
const move = (page, zoom) => page.evaluate(async (factor) => {
  const { map } = window.citystitch;
  map.fit();
  if (factor > 1) map.zoomBy(factor);
  await new Promise((next) => setTimeout(next, 4000));
  map.frames.length = 0;
  const frames = [];
  let last = performance.now();
  const until = last + 2000;
  while (last < until) {
    map.zoomBy(frames.length % 2 ? 1.02 : 1 / 1.02);
    await new Promise((next) => requestAnimationFrame(next));
    const now = performance.now();
    frames.push(now - last);
    last = now;
  }
  return { draw: [...map.frames], frames, shown: map.tiles.boxes.length, seams: map.seams.boxes.length, level: map.level };
}, zoom);

(async () => {
  const browser = await chromium.launch({ executablePath, args: ["--no-sandbox"] });
  const found = {};
  for (const [name, width, height] of [["desktop", 1280, 900], ["phone", 390, 844]]) {
    const context = await browser.newContext({ viewport: { width, height } });
    const page = await context.newPage();
    await page.goto(url);
    await page.waitForFunction(() => document.body.dataset.firstDraw && window.citystitch.read === 1, null, { timeout: 300000 });
    const first = Number(await page.evaluate(() => document.body.dataset.firstDraw));
    const whole = await move(page, 1);
    const near = await move(page, 12);
    await page.evaluate(() => window.citystitch.map.fit());
    await page.waitForTimeout(3000);
    await page.screenshot({ path: `${folder}/${name}.png`, fullPage: true });
    const tell = ({ draw, frames, shown, seams, level }) => ({ draw: median(draw), frame: median(frames), shown, seams, level });
    found[name] = { first, whole: tell(whole), near: tell(near) };
    await context.close();
  }
  await browser.close();
  console.log(JSON.stringify(found));
})().catch((error) => { console.error(error); process.exit(1); });
