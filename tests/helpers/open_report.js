// Open a page in headless Chromium: node open_report.js FILE.html FOLDER
// Prints as JSON what the console said, what was fetched, and what the page holds; leaves screenshots in the folder.
const path = require("path");
const { execSync } = require("child_process");
const root = execSync("npm root --global 2>/dev/null").toString().trim();
const { chromium } = require(path.join(root, "playwright-core"));

const VIEWS = {
  desktop: { viewport: { width: 1280, height: 800 } },
  phone: { viewport: { width: 390, height: 844 }, isMobile: true, hasTouch: true },
  dark: { viewport: { width: 1280, height: 800 }, colorScheme: "dark" },
};

async function open(browser, file, folder, name, options) {
  const context = await browser.newContext(options);
  const page = await context.newPage();
  const said = [], fetched = [];
  page.on("console", (message) => said.push(`${message.type()}: ${message.text()}`));
  page.on("pageerror", (error) => said.push(`error: ${error.message}`));
  page.on("request", (request) => {
    if (!request.url().startsWith("data:")) fetched.push(request.url());
  });
  await page.goto("file://" + path.resolve(file));
  const found = await page.evaluate(() => {
    const all = (what) => [...document.querySelectorAll(what)];
    const rgb = (colour) => colour.match(/[\d.]+/g).slice(0, 3).map(Number);
    return {
      title: document.title,
      wider: document.documentElement.scrollWidth - document.documentElement.clientWidth,
      links: all("nav a").map((a) => [a.getAttribute("href"), document.querySelector(a.getAttribute("href")) !== null]),
      sections: all("main > section").map((section) => section.id),
      unnamed: all("svg:not([aria-label])").length + all("img:not([alt])").length,
      images: all("img").map((image) => [image.alt, image.naturalWidth, image.naturalHeight]),
      maps: all(".map svg").map((svg) => ({
        tiles: svg.querySelectorAll("rect[class^=shade], rect.unknown").length,
        missing: svg.querySelectorAll("rect.missing").length,
        footprints: svg.querySelectorAll("image, use").length,
      })),
      scripts: all("script").length,
      ids: all("[id]").length - new Set(all("[id]").map((e) => e.id)).size,
      ink: rgb(getComputedStyle(document.body).color),
      paper: rgb(getComputedStyle(document.body).backgroundColor),
    };
  });
  await page.screenshot({ path: path.join(folder, `${name}.png`) });
  await page.screenshot({ path: path.join(folder, `${name}-whole.png`), fullPage: true });
  if (name === "desktop") await page.pdf({ path: path.join(folder, "print.pdf"), format: "A4" });
  await context.close();
  return { ...found, said, fetched };
}

(async () => {
  const [file, folder] = process.argv.slice(2);
  const browser = await chromium.launch({ executablePath: "/usr/bin/chromium", args: ["--no-sandbox"] });
  const found = {};
  for (const [name, options] of Object.entries(VIEWS)) {
    found[name] = await open(browser, file, folder, name, options);
  }
  await browser.close();
  console.log(JSON.stringify(found));
})();
