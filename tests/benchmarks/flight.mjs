// Flies over a city that `citystitch view` shows, row by row, and prints what that took.
// usage: NODE_PATH=$(npm root -g) node flight.mjs URL HEIGHT ROWS SIDE: metres above it, rows, and side of the city (m)
import { createRequire } from "node:module";

const require = createRequire(import.meta.url);
const { chromium } = require("playwright-core");
const [url, height, rows, side] = [process.argv[2], ...process.argv.slice(3).map(Number)];
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];
const browser = await chromium.launch({ executablePath: "/usr/bin/chromium", args });
const page = await browser.newPage({ viewport: { width: 1280, height: 800 } });
await page.goto(url);
await page.waitForFunction(() => window.citystitch?.state.first !== null, null, { timeout: 60000 });
console.log("first picture (ms):", await page.evaluate(() => Math.round(window.citystitch.state.first)));
const settle = () => page.waitForFunction(() => !window.citystitch.tiles.isLoading, null, { timeout: 60000 });
await settle();
const middle = await page.evaluate(() => window.citystitch.controls.target.toArray());
const frames = [];
for (let row = 0; row < rows; row++) for (let k = 0; k <= 12; k++) {
  const x = middle[0] + (row % 2 ? -1 : 1) * side * (k / 12 - 0.5), z = middle[2] + side * ((row + 0.5) / rows - 0.5);
  frames.push(...await page.evaluate(async ([place, target]) => {
    const { camera, controls } = window.citystitch, from = [camera.position.clone(), controls.target.clone()], found = [];
    let before = null;
    for (let step = 1; step <= 10; step++) {
      camera.position.fromArray(place).lerp(from[0], 1 - step / 10);
      controls.target.fromArray(target).lerp(from[1], 1 - step / 10);
      controls.update();
      const now = await new Promise(requestAnimationFrame);
      if (before !== null) found.push(now - before);
      before = now;
    }
    return found;
  }, [[x, middle[1] + height, z - height], [x, middle[1], z]]));
  await settle();
}
frames.sort((a, b) => a - b);
console.log("frames (ms): median", frames[frames.length >> 1].toFixed(0), "95 %", frames[Math.floor(0.95 * frames.length)].toFixed(0));
console.log("read (MB):", await page.evaluate(() => (window.citystitch.state.bytes / 1e6).toFixed(1)));
await browser.close();
