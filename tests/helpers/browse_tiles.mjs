// Opens 3D Tiles in our page (three.js, 3DTilesRendererJS) and in CesiumJS, and prints what it saw as JSON.
// usage: NODE_PATH=$(npm root -g) node browse_tiles.mjs PAGE_URL CESIUM_URL CHROMIUM FOLDER: pictures go into the folder
import { createRequire } from "node:module";

const require = createRequire(import.meta.url);
const { chromium } = require("playwright-core");
const [url, cesium, executablePath, folder] = process.argv.slice(2);
const seen = { console: [], foreign: [] };
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];
const browser = await chromium.launch({ executablePath, args });

async function open(place, width, height) {
  const page = await browser.newPage({ viewport: { width, height } });
  page.on("console", (message) => { if (message.type() === "error") seen.console.push(message.text()); });
  page.on("pageerror", (error) => seen.console.push(String(error)));
  page.on("request", (request) => { if (!request.url().startsWith(new URL(place).origin) && !/^(data|blob):/.test(request.url())) seen.foreign.push(request.url()); });
  await page.goto(place);
  return page;
}
const settle = async (page) => {
  await page.waitForFunction(() => window.citystitch.state.first !== null && !window.citystitch.tiles.isLoading, null, { timeout: 60000 });
  await page.waitForTimeout(500);
};
const text = (page, selector) => page.textContent(selector);

try {
  const page = await open(url, 1000, 700);
  await settle(page);
  await page.focus("#view");
  for (let k = 0; k < 9; k++) await page.keyboard.press("-");
  await page.waitForTimeout(500);
  await settle(page);
  seen.far = await text(page, "#detail");
  seen.unknown = await page.evaluate(() => [...new Set([...window.citystitch.meshes].flatMap((mesh) => mesh.userData.own.rows).filter((row) => row.lod?.startsWith("1")).map((row) => row.roof_rmse))]);
  await page.keyboard.press("0");
  for (let k = 0; k < 2; k++) await page.keyboard.press("+");
  await page.waitForTimeout(500);
  await settle(page);
  seen.near = await text(page, "#detail");
  // Buildings by what is under a grid of places, as a click would find it.
  seen.picked = [];
  for (let x = 60; x < 1000; x += 60) {
    for (let y = 100; y < 640; y += 40) {
      await page.mouse.click(x, y);
      const row = await page.$$eval("#facts tr", (rows) => Object.fromEntries(rows.map((one) => [one.cells[0].textContent, one.cells[1].textContent])));
      if (!(await page.isHidden("#panel")) && row.lod) seen.picked.push({ id: await text(page, "#name"), ...row });
    }
  }
  seen.modes = {};
  for (const mode of await page.$$eval("#mode option", (all) => all.map((one) => one.value))) {
    await page.selectOption("#mode", mode);
    seen.modes[mode] = await page.evaluate(() => new Set([...window.citystitch.meshes].flatMap((mesh) => Array.from(mesh.geometry.getAttribute("color").array, (one, k) => k % 3 ? [] : one).flat())).size);
  }
  await page.selectOption("#mode", "height");
  seen.mixed = await page.evaluate(() => [...window.citystitch.meshes].flatMap((mesh) => {
    const { index } = mesh.geometry, colour = mesh.geometry.getAttribute("color"), at = (k) => [colour.getX(k), colour.getY(k), colour.getZ(k)].join();
    return Array.from({ length: index.count / 3 }, (_, k) => new Set([0, 1, 2].map((j) => at(index.getX(3 * k + j)))).size > 1 ? [k] : []).flat();
  }).length);
  await page.screenshot({ path: `${folder}/view.png` });
  await page.keyboard.press("Escape");
  await page.focus("#view");
  await page.keyboard.press("m");
  await page.mouse.click(480, 350);
  await page.mouse.click(520, 400);
  seen.length = await text(page, "#length");
  await page.keyboard.press("Escape");
  seen.ended = await text(page, "#length");
  const phone = await open(url, 390, 844);
  await settle(phone);
  seen.overflow = await phone.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
  await phone.screenshot({ path: `${folder}/phone.png` });
  await phone.close();
  await page.close();

  const globe = await open(cesium, 800, 600);
  await globe.waitForFunction(() => window.seen?.ready && window.seen.tileset.tilesLoaded, null, { timeout: 120000 });
  seen.cesium = await globe.evaluate(() => {
    const { tileset, widget, failed, loaded } = window.seen;
    const found = {};
    for (let x = 20; x < 800; x += 20) for (let y = 20; y < 600; y += 20) {
      const feature = widget.scene.pick(new Cesium.Cartesian2(x, y));
      if (feature?.getPropertyIds?.().includes("id")) found[feature.getProperty("id")] = Object.fromEntries(feature.getPropertyIds().map((key) => [key, feature.getProperty(key)]));
    }
    return { failed, loaded, error: tileset.root.children[0].geometricError, found };
  });
  await globe.screenshot({ path: `${folder}/cesium.png` });
} catch (error) {
  seen.error = String(error);
} finally {
  await browser.close();
}
console.log(JSON.stringify(seen));
