"""The report page and the documentation site in Chromium: three widths, light and dark.

Each page must log no errors, fit into its window, and have text whose contrast to its background
reaches level AA of the WCAG. Screenshots are written to the folder that the environment variable
SCREENSHOTS names, if it is set.
"""

import inspect
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from run_folders import make_run, write_page

from wpt_agents import WPT
from wpt_agents.zoo.plan.methods import METHODS

ROOT = Path(__file__).parents[1]
WIDTHS = (390, 820, 1440)
SCHEMES = ("light", "dark")
PAGES = (
    *("index", "quickstart", "data", "results", "experiments", "when-it-does-not-learn"),
    *("api/model", "search", "algorithms/drqv2", "tutorials/4-a-row-of-the-paper"),
)
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--hide-scrollbars", "--force-device-scale-factor=1", "--allow-file-access-from-files"),
)
# Elements that leave the window to the right without standing in something that scrolls.
OVERFLOWING = """
const scrolls = e => { for (e = e.parentElement; e; e = e.parentElement) {
  const x = getComputedStyle(e).overflowX;
  if (e !== document.body && e !== document.documentElement && x !== 'visible') return true; }
  return false; };
return [...document.querySelectorAll('body *')].filter(e => {
  const box = e.getBoundingClientRect();
  return box.width && box.left < innerWidth && box.right > innerWidth + 1 && e.checkVisibility()
    && !scrolls(e);
}).map(e => e.tagName + '.' + e.className + ': ' + e.textContent.trim().slice(0, 60));
"""
# Text whose contrast to the background is below 4.5, or below 3 if it is large: WCAG 1.4.3.
PALE = """
const parse = c => (c.match(/[\\d.]+/g) || []).map(Number);
const light = c => c.slice(0, 3).map(v => v / 255).map(
  v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4
).reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
const over = (top, below) => { const a = top[3] ?? 1;
  return [0, 1, 2].map(i => a * top[i] + (1 - a) * below[i]); };
const background = e => { const layers = [];
  for (; e; e = e.parentElement) { const c = parse(getComputedStyle(e).backgroundColor);
    layers.push(c); if ((c[3] ?? 1) === 1) break; }
  const page = matchMedia('(prefers-color-scheme: dark)').matches ? [0, 0, 0] : [255, 255, 255];
  return layers.reverse().reduce((below, top) => over(top, below), page); };
const found = new Set();
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const text = walker.currentNode.textContent.trim(), e = walker.currentNode.parentElement;
  if (!text || !e.checkVisibility({visibilityProperty: true, opacityProperty: true})) continue;
  if (e.closest('svg, script, style, noscript') || !e.getBoundingClientRect().width) continue;
  const style = getComputedStyle(e), below = background(e);
  const ink = over(parse(style.color), below), size = parseFloat(style.fontSize);
  const [high, low] = [light(ink), light(below)].sort((a, b) => b - a);
  const ratio = (high + 0.05) / (low + 0.05);
  const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
  if (ratio < (large ? 3 : 4.5))
    found.add(`${ratio.toFixed(2)} ${style.color} ${e.className}: ${text.slice(0, 50)}`);
}
return [...found];
"""

# What has to be scrolled sideways to be read, with everything unfolded.
SCROLLING = """
document.querySelectorAll('details').forEach(details => details.open = true);
return [...document.querySelectorAll('.scroll, .strip, pre')].filter(
  e => e.scrollWidth > e.clientWidth + 1).map(e => e.textContent.trim().slice(0, 60));
"""
# By how many of 100 pixels a table scrolls, and how far its first cell is from its edge then.
FIRST_COLUMN = """
const box = document.querySelector('#table-5 .scroll');
box.scrollLeft = 100;
const left = e => e.getBoundingClientRect().left;
return [box.scrollLeft, left(box.querySelector('td')) - left(box)];
"""

pytestmark = [pytest.mark.nightly, pytest.mark.filterwarnings("ignore::ResourceWarning")]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("sphinx", reason='needs `pip install -e ".[docs]"`')
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    subprocess.run([*command, str(ROOT / "docs"), str(folder)], check=True)
    return folder


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    runs = tmp_path_factory.mktemp("runs")
    for seed in (0, 1):
        make_run(runs, "dmc-walker-run", seed, "wpt", (700.0, 760.0))
        make_run(runs, "dmc-walker-run", seed, "scratch", (90.0, 110.0))
        make_run(runs, "metaworld-reach", seed, "wpt", (9.0, 1.0 + 8 * seed))
    failed = runs / "debug" / "wpt" / "dmc-walker-walk_0"
    failed.mkdir()
    (failed / "config.yaml").write_text("task: x")
    (failed / "error.txt").write_text("Traceback\nRuntimeError: out of luck\n")
    words = "run --tasks walker-stand --preset debug --workers 1 --device cpu --out"
    command = [sys.executable, "-m", "wpt_agents.zoo", *words.split(), str(runs)]
    subprocess.run(command, check=True)  # a whole run, with its video and pictures
    page = runs / "report" / "index.html"
    write_page(runs, page)
    return page


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    webdriver = pytest.importorskip("selenium.webdriver", reason='needs `pip install -e ".[docs]"`')
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.skip("needs Chromium: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    service = webdriver.ChromeService(driver)
    chrome = webdriver.Chrome(options, service)
    yield chrome
    chrome.quit()


def look(browser, page, name, width, scheme):
    """Open a page and return what is wrong with it."""
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get_log("browser")  # those of earlier pages
    browser.get(page.as_uri())
    if folder := os.environ.get("SCREENSHOTS"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        file = f"{name.replace('/', '-')}-{width}-{scheme}.png"
        browser.save_screenshot(str(Path(folder) / file))
    errors = [
        entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"
    ]
    wide = browser.execute_script(OVERFLOWING)
    pale = browser.execute_script(PALE)
    return {"errors": errors, "overflowing": wide[:5], "pale": pale[:8]}


FINE = {"errors": [], "overflowing": [], "pale": []}


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("width", WIDTHS)
def test_the_report_can_be_read(browser, report, width, scheme):
    assert look(browser, report, "report", width, scheme) == FINE


@pytest.fixture(scope="module")
def wide_report(tmp_path_factory):
    """A report on all methods, with three seeds and the budget, seeds and commit in every cell."""
    runs = tmp_path_factory.mktemp("wide")
    for task in ("dmc-walker-run", "metaworld-button-press-topdown-wall"):
        for method in METHODS:
            for seed in range(3):
                make_run(runs, task, seed, method, (7.0, 760.0))
    make_run(runs, "dmc-cheetah-run", preset="debug evaluate.during_episodes=2")
    page = runs / "report" / "index.html"
    write_page(runs, page)
    return page


def test_nothing_of_the_report_scrolls_sideways_in_a_wide_window(browser, wide_report):
    look(browser, wide_report, "wide-report", 1440, "light")
    assert browser.execute_script(SCROLLING) == []


def test_the_first_column_of_the_report_stays_in_a_narrow_window(browser, wide_report):
    look(browser, wide_report, "wide-report", 390, "light")
    scrolled, distance = browser.execute_script(FIRST_COLUMN)
    assert scrolled == 100 and 0 <= distance < 2


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("page", PAGES)
def test_the_site_can_be_read(browser, site, page, width, scheme):
    assert look(browser, site / f"{page}.html", page, width, scheme) == FINE


def test_a_long_signature_has_a_line_for_each_parameter(site):
    page = (site / "api" / "public.html").read_text()
    lines = re.findall(r'<dd[^>]*>\s*<em class="sig-param">', page)
    assert len(lines) > len(inspect.signature(WPT).parameters)  # methods have some, too


def test_the_search_page_says_how_to_search(site):
    assert "Enter words in the search field" in (site / "search.html").read_text()


def test_the_search_works_offline(browser, site):
    browser.get((site / "search.html").as_uri() + "?q=guidance")
    script = "return document.querySelectorAll('#search-results li').length"
    for _ in range(100):
        if browser.execute_script(script):
            break
        browser.implicitly_wait(0.1)
        browser.execute_async_script("setTimeout(arguments[0], 100)")
    assert browser.execute_script(script) > 3


def test_what_is_wrong_is_seen(browser, tmp_path):
    page = tmp_path / "page.html"
    page.write_text(
        "<body style='background:#fff'><p style='color:#999'>pale</p>"
        "<p style='width:3000px;background:#fff;color:#000'>wide</p>"
        "<div style='overflow-x:auto'><p style='width:3000px;color:#000'>scrolls</p></div>"
        "<script>nothing.here</script>"
    )
    wrong = look(browser, page, "wrong", 390, "light")
    assert len(wrong["errors"]) == 1 and "nothing is not defined" in wrong["errors"][0]
    assert wrong["overflowing"] == ["P.: wide"]
    assert len(wrong["pale"]) == 1 and "pale" in wrong["pale"][0]
