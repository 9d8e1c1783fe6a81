// Open pages in headless Chromium; print as JSON what each said on its console, asked for, and how wide it is.
// usage: NODE_PATH=$(npm root -g) node open_pages.mjs PAGES.json   with {"width": 390, "urls": [...]}
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";

const require = createRequire(import.meta.url);
const { chromium } = require("playwright-core");
const asked = JSON.parse(readFileSync(process.argv[2], "utf8"));
const browser = await chromium.launch({ executablePath: "/usr/bin/chromium", args: ["--no-sandbox"] });
const context = await browser.newContext({ viewport: { width: asked.width, height: 844 } });
const found = [];
for (const url of asked.urls) {
  const page = await context.newPage();
  const said = [], fetched = [], failed = [];
  page.on("console", (message) => said.push(`${message.type()}: ${message.text()}`));
  page.on("pageerror", (error) => said.push(`error: ${error}`));
  page.on("request", (request) => fetched.push(request.url()));
  page.on("requestfailed", (request) => failed.push(request.url()));
  await page.goto(url);
  const [title, width, formulas, links] = await page.evaluate(() => [
    document.title,
    document.documentElement.scrollWidth,
    document.querySelectorAll("math").length,
    [...document.querySelectorAll("a[href]")].map((link) => link.href),
  ]);
  found.push({ url, title, width, formulas, links, said, fetched, failed });
  await page.close();
}
await browser.close();
console.log(JSON.stringify(found));
