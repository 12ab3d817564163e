"""The page of `raysweep view` in Chromium: view_page.py ADDRESS PLAN [FOLDER FOR SCREENSHOTS]"""

import sys
from pathlib import Path

from playwright.sync_api import expect, sync_playwright

address, plan = sys.argv[1], Path(sys.argv[2]).read_text()
screenshots = Path(sys.argv[3]) if len(sys.argv) > 3 else None
# A busy machine may take its time.
expect.set_options(timeout=120_000)
# Long enough that a slow browser can still pause it.
LONG = plan.replace("average = 4", "average = 400")
assert LONG != plan


def shot(page, name):
    if screenshots:
        screenshots.mkdir(exist_ok=True)
        page.screenshot(path=screenshots / f"{name}.png", full_page=True)


def run(page, plan):
    """Starts a plan and waits for its end; returns the session's name."""
    before = page.locator("#run-name").text_content()
    page.fill("#plan", plan)
    page.click("#start")
    expect(page.locator("#run-name")).not_to_have_text(before)
    expect(page.locator("#notes")).to_contain_text("The run is complete.")
    return page.locator("#run-name").text_content()


def first_visit(page):
    """Checks, starts, pauses and continues a run, and opens its report."""
    page.goto(address)
    expect(page.locator("#state")).to_have_text("idle")
    page.fill("#plan", "kind = \"sweep\"\n[sweep]\naverage = 0")
    page.click("#check")
    expect(page.locator("#checked")).to_contain_text("sweep.average")
    page.fill("#plan", LONG)
    page.click("#check")
    expect(page.locator("#checked")).to_contain_text("frames")
    shot(page, "check")
    page.click("#start")
    page.click("#pause")
    expect(page.locator("#state")).to_have_text("paused")
    shot(page, "paused")
    page.click("#continue")
    expect(page.locator("#notes")).to_contain_text("The run is complete.")
    expect(page.locator("#figures")).to_contain_text("30 of 30")
    expect(page.locator("#live-names button")).to_have_count(3)
    expect(page.locator("#live-picture canvas.image")).to_be_visible()
    page.locator("#live-picture canvas.image").hover(position={"x": 60, "y": 60})
    expect(page.locator("#live-picture .readout")).to_contain_text("row ")
    with page.context.expect_page() as opened:
        page.get_by_role("link", name="Open the report").click()
    expect(opened.value.locator("h1")).to_contain_text("groove")
    opened.value.close()


def viewfinder(page):
    """Watches the viewfinder, changes what the projector shows, and ends it."""
    page.fill("#plan", "kind = \"viewfinder\"")
    page.click("#start")
    expect(page.locator("#finder-figures")).to_contain_text("of the best")
    page.get_by_role("button", name="viewfinder", exact=True).click()
    expect(page.locator("#live-about")).to_contain_text("camera counts")
    page.get_by_role("button", name="rows", exact=True).click()
    expect(page.get_by_role("button", name="rows", exact=True)).to_have_attribute("aria-pressed", "true")
    shot(page, "viewfinder")
    page.click("#cancel")
    expect(page.locator("#finder")).to_be_hidden()


def visit(page, name):
    """Runs once more, and compares with the run before."""
    page.goto(address)
    expect(page.locator("#state")).to_have_text("idle")
    last = run(page, plan)
    expect(page.locator("#live-names button")).to_have_count(3)
    live = page.locator("#live-picture canvas.image")
    expect(live).to_be_visible()
    live.focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#delays .u-wrap")).to_be_visible()
    shot(page, f"run-{name}")
    # With the keyboard: the tabs, then the session, then the pixel.
    page.focus("#tab-run")
    page.keyboard.press("ArrowRight")
    page.locator(f"#sessions .choose[title='{last}']").click()
    picture = page.locator("#session canvas.image").first
    expect(picture).to_be_visible()
    picture.focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#session .u-wrap")).to_be_visible()
    page.locator("#sessions li", has_text="groove").nth(1).get_by_role("button", name="compare").click()
    expect(page.locator("#session h3").nth(2)).to_contain_text("RMS")
    expect(page.locator("#session canvas.image")).to_have_count(3)
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= page.viewport_size["width"], f"{name}: {width} pixels wide"
    shot(page, f"sessions-{name}")


with sync_playwright() as playwright:
    browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
    complaints = []
    for turn, (scheme, width) in enumerate([("light", 1280), ("dark", 400)]):
        context = browser.new_context(color_scheme=scheme, viewport={"width": width, "height": 900})
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        if turn == 0:
            first_visit(page)
            viewfinder(page)
        visit(page, f"{scheme}-{width}")
        context.close()
    browser.close()
    assert not complaints, complaints
