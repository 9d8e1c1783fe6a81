// Opens the page of a city that is served, edits it, waits until the page shows the edit, and prints what it saw as JSON.
// usage: NODE_PATH=$(npm root -g) node browse_edits.mjs URL CHROMIUM FOLDER BODY: pictures go into the folder
import { createRequire } from "node:module";

const require = createRequire(import.meta.url);
const { chromium } = require("playwright-core");
const [url, executablePath, folder, body] = process.argv.slice(2);
const seen = { console: [], fetched: [] };
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];
const browser = await chromium.launch({ executablePath, args, timeout: 300000 });
const names = (page) => page.evaluate(() => [...new Set([...window.citystitch.meshes].flatMap((mesh) => mesh.userData.own.rows.map((row) => row.id)).filter(Boolean))]);
const camera = (page) => page.evaluate(() => [...window.citystitch.camera.position, ...window.citystitch.tiles.group.matrixWorld.elements]);

try {
  const page = await browser.newPage({ viewport: { width: 1000, height: 700 } });
  page.setDefaultTimeout(600000);
  page.on("console", (message) => { if (message.type() === "error") seen.console.push(message.text()); });
  page.on("pageerror", (error) => seen.console.push(String(error)));
  page.on("response", (response) => { if (response.url().includes("/content/")) seen.fetched.push(response.status()); });
  await page.goto(url);
  await page.waitForFunction(() => window.citystitch.state.first !== null && !window.citystitch.tiles.isLoading);
  await page.focus("#view");
  await page.keyboard.press("ArrowRight");
  await page.waitForTimeout(3000); // the page has asked for the version
  seen.before = { names: await names(page), camera: await camera(page) };
  await page.screenshot({ path: `${folder}/before.png` });
  const reply = await page.evaluate(async (text) => (await fetch("edits", { method: "POST", headers: { "Content-Type": "application/json" }, body: text })).status, body);
  seen.reply = reply;
  await page.waitForFunction(() => window.citystitch.state.swaps === 1);
  await page.waitForTimeout(500);
  seen.after = { names: await names(page), camera: await camera(page) };
  seen.children = await page.evaluate(() => window.citystitch.tiles.group.parent.children.filter((one) => one === window.citystitch.tiles.group).length);
  await page.screenshot({ path: `${folder}/after.png` });
  await page.focus("#view");
  await page.keyboard.press("s");
  await page.mouse.click(350, 330);
  await page.mouse.click(650, 370);
  await page.waitForFunction(() => window.citystitch.section.ends);
  await page.waitForTimeout(1000);
  seen.section = { words: await page.textContent("#length"), pressed: await page.getAttribute("#section", "aria-pressed") };
  await page.screenshot({ path: `${folder}/section.png` });
  await page.setViewportSize({ width: 390, height: 844 });
  await page.waitForTimeout(500);
  await page.screenshot({ path: `${folder}/phone.png` });
  seen.overflow = await page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
  await page.focus("#view");
  await page.keyboard.press("Escape");
  seen.section.left = await page.evaluate(() => window.citystitch.section.meshes.length);
} catch (error) {
  seen.error = String(error);
} finally {
  await browser.close();
}
console.log(JSON.stringify(seen));
