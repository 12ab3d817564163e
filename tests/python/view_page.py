"""The page of `raysweep view` in Chromium:
view_page.py ADDRESS PLAN ADDRESS_OF_A_RIG_THAT_ASKS ADDRESS_OF_A_DOT_RIG PLAN_OF_BATCHES [FOLDER FOR SCREENSHOTS]"""

import re
import shutil
import sys
from pathlib import Path

from playwright.sync_api import expect, sync_playwright

address, plan, asking = sys.argv[1], Path(sys.argv[2]).read_text(), sys.argv[3]
dots, batches = sys.argv[4], Path(sys.argv[5]).read_text()
screenshots = Path(sys.argv[6]) if len(sys.argv) > 6 else None
# A busy machine may take its time.
PATIENCE_MS = 120_000
expect.set_options(timeout=PATIENCE_MS)
# Long enough that a slow browser can still pause it.
LONG = plan.replace("average = 4", "average = 400")
assert LONG != plan
SHORT = "kind = \"sweep\"\nname = \"asked\"\n[sweep]\ndelay_us = [-300, 0, 300]\nexposure_us = [500]\naverage = 2\n"
FILM = "kind = \"film\"\nname = \"film\"\n[film]\ncycles = 5\n[[product]]\nname = \"epipolar\"\nkind = \"epipolar\"\n"
DARKS = "kind = \"darks\"\nname = \"darks\"\n[darks]\nexposure_us = [100]\nframes = 2\n"
SCHEMES = ["light", "dark"]
WIDTHS = [1280, 400]


def shot(page, name):
    if screenshots:
        screenshots.mkdir(exist_ok=True)
        page.screenshot(path=screenshots / f"{name}.png", full_page=True)


def shots(page, name):
    """The page in both schemes and widths."""
    if not screenshots:
        return
    size = page.viewport_size
    for scheme in SCHEMES:
        page.emulate_media(color_scheme=scheme)
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 900})
            page.wait_for_timeout(500)
            fits(page, name)
            shot(page, f"{name}-{scheme}-{width}")
    page.set_viewport_size(size)
    page.emulate_media(color_scheme=SCHEMES[0])


def fits(page, name):
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= page.viewport_size["width"], f"{name}: {width} pixels wide"


def run(page, plan):
    """Starts a plan and waits for its end; returns the session's name."""
    # A page that has just been opened does not yet name the run before.
    expect(page.locator("#state")).to_have_text("idle")
    before = page.locator("#run-name").text_content()
    page.fill("#plan", plan)
    page.click("#start")
    expect(page.locator("#run-name")).not_to_have_text(before)
    expect(page.locator("#notes")).to_contain_text("The run is complete.")
    return page.locator("#run-name").text_content()


def first_visit(page):
    """Checks, starts, cancels, resumes, pauses and continues a run, and opens its report."""
    page.goto(address)
    expect(page.locator("#state")).to_have_text("idle")
    page.fill("#plan", "kind = \"sweep\"\n[sweep]\naverage = 0")
    page.click("#check")
    expect(page.locator("#checked")).to_contain_text("sweep.average")
    page.fill("#plan", LONG)
    page.click("#check")
    expect(page.locator("#checked dt", has_text="frames")).to_be_visible()
    shot(page, "check")
    page.click("#start")
    # A run that is still being prepared would leave no session.
    page.click("#pause")
    expect(page.locator("#state")).to_have_text("paused")
    page.click("#cancel")
    expect(page.locator("#notes")).to_contain_text("The run is cancelled.")
    begun = page.locator("#run-name").text_content()
    page.click("#tab-sessions")
    page.locator(f"#sessions .choose[title='{begun}']").click()
    page.get_by_role("button", name="Resume").click()
    page.click("#pause")
    expect(page.locator("#state")).to_have_text("paused")
    expect(page.locator("#run-name")).to_have_text(begun)
    shot(page, "paused")
    page.click("#continue")
    expect(page.locator("#notes")).to_contain_text("The run is complete.")
    expect(page.locator("#notes")).to_contain_text("not calibrated")
    expect(page.locator("#figures")).to_contain_text("30 of 30")
    expect(page.locator("#figures dt").first).to_have_text("measurements")
    expect(page.locator("#live-names button")).to_have_count(3)
    expect(page.locator("#live-picture canvas.image")).to_be_visible()
    page.locator("#live-picture canvas.image").hover(position={"x": 60, "y": 60})
    expect(page.locator("#live-picture .readout")).to_contain_text("row ")
    with page.context.expect_page() as opened:
        page.get_by_role("link", name="Open the report").click()
    expect(opened.value.locator("h1")).to_contain_text("groove")
    opened.value.close()
    tools(page)


def tools(page):
    """Changes colours, limits and zoom of the live picture."""
    live = page.locator("#live-picture")
    canvas = live.locator("canvas.image")
    # Whether any pixel is of a colour, and the brightest red.
    look = """canvas => {
        const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
        copy.drawImage(canvas, 0, 0);
        const { data } = copy.getImageData(0, 0, canvas.width, canvas.height);
        let [isColoured, brightest] = [false, 0];
        for (let at = 0; at < data.length; at += 4) {
            isColoured ||= data[at] !== data[at + 2];
            brightest = Math.max(brightest, data[at]);
        }
        return [isColoured, brightest];
    }"""
    assert canvas.evaluate(look) == [False, 255], canvas.evaluate(look)
    live.get_by_label("Colours").select_option("viridis")
    assert canvas.evaluate(look)[0]
    live.get_by_label("Colours").select_option("grey")
    # Ten times as much as the brightest pixels is their white.
    upper = live.get_by_label("Upper limit")
    limit = 10 * float(upper.input_value())
    upper.fill(str(limit))
    upper.press("Enter")
    expect(live.get_by_label("automatic limits")).not_to_be_checked()
    is_coloured, brightest = canvas.evaluate(look)
    assert not is_coloured and brightest < 64, brightest
    live.get_by_label("automatic limits").check()
    assert canvas.evaluate(look)[1] == 255
    # The pixel under the cursor stays there while it grows, and its neighbours move away.
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    corner = (box["x"] + 8, box["y"] + 8)
    # To a pixel, as the page may be scrolled by parts of one.
    first, magnified = re.compile("row [01], column [01]:"), re.compile("row (19|20|21), column 1[34]:")
    page.mouse.move(*corner)
    expect(live.locator(".readout")).to_contain_text(first)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    for _ in range(8):
        page.mouse.wheel(0, -100)
    page.mouse.move(*corner)
    expect(live.locator(".readout")).to_contain_text(magnified)
    shot(page, "zoom")
    live.get_by_role("button", name="Whole picture").click()
    # To click it, the page may have been scrolled.
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + 8, box["y"] + 8)
    expect(live.locator(".readout")).to_contain_text(first)


def dot_rig(page):
    """Watches the batches of a dot rig."""
    page.goto(dots)
    run(page, batches)
    expect(page.locator("#live-names button")).to_have_text(["floodlit"])
    expect(page.locator("#live-about")).to_contain_text("128 × 128 px · batch 1")
    # A dot rig has no projector whose VSYNC is watched.
    expect(page.locator("#vsync-card")).to_be_hidden()
    canvas = page.locator("#live-picture canvas.image")
    canvas.hover(position={"x": 60, "y": 60})
    expect(page.locator("#live-picture .readout")).to_contain_text("row ")
    shots(page, "dots")
    page.click("#tab-sessions")
    page.locator("#sessions .choose").click()
    expect(page.locator("#session canvas.image")).to_be_visible()
    has_thumbnail(page)


def has_thumbnail(page):
    """The first session of the list has a small picture."""
    thumbnail = page.locator("#sessions .choose img").first
    expect(thumbnail).to_be_visible()
    page.wait_for_function("image => image.complete && image.naturalWidth > 1", arg=thumbnail.element_handle())


def viewfinder(page):
    """Watches a viewfinder, changes what the projector shows, chooses a region, and ends it."""
    page.click("#find")
    figures = page.locator("#finder-figures")
    expect(figures).to_contain_text("of the best")
    expect(figures).to_contain_text("rows 0 to 47, columns 0 to 31")
    expect(page.locator("#live-about")).to_contain_text("camera counts")
    page.get_by_role("button", name="rows", exact=True).click()
    expect(page.get_by_role("button", name="rows", exact=True)).to_have_attribute("aria-pressed", "true")
    page.check("#finder-cross")
    live = page.locator("#live-picture canvas.image")
    live.scroll_into_view_if_needed()
    box = live.bounding_box()
    pixel = box["width"] / 32
    page.mouse.move(box["x"] + 8.5 * pixel, box["y"] + 4.5 * pixel)
    page.mouse.down()
    page.mouse.move(box["x"] + 23.5 * pixel, box["y"] + 27.5 * pixel, steps=4)
    page.mouse.up()
    expect(figures).to_contain_text("rows 4 to 27, columns 8 to 23")
    expect(page.locator("#row-cut-text")).to_have_text("Counts along row 16")
    expect(page.locator("#column-cut .u-wrap")).to_be_visible()
    shots(page, "viewfinder")
    page.click("#finder-whole")
    expect(figures).to_contain_text("rows 0 to 47, columns 0 to 31")
    page.click("#cancel")
    expect(page.locator("#finder")).to_be_hidden()
    # A simulated rig has its board placed without a question.
    page.click("#align")
    shown = page.get_by_role("button", name="align", exact=True)
    expect(shown).to_have_attribute("aria-pressed", "true")
    page.click("#cancel")
    expect(page.locator("#finder")).to_be_hidden()


def questions(page):
    """Answers what a run with a projector that an operator works asks."""
    page.goto(asking)
    page.fill("#plan", SHORT)
    page.click("#start")
    for wanted in ["light off", "white"]:
        expect(page.locator("#question-text")).to_contain_text(wanted)
        if wanted == "white":
            shot(page, "question")
            # In real time, the jitter of the VSYNC is told about once a second.
            expect(page.locator("#vsync .u-wrap")).to_be_visible()
            expect(page.locator("#vsync-text")).to_contain_text("period 16666.")
        page.click("#answer")
    expect(page.locator("#notes")).to_contain_text("The run is complete.")
    expect(page.locator("#notes")).to_contain_text("the run is over")
    expect(page.locator("#question")).to_be_hidden()


def warnings(page):
    """Reads the warnings of a session."""
    page.goto(address)
    page.click("#tab-sessions")
    session = page.locator("#sessions li", has_text="warned")
    expect(session).to_contain_text("complete · 1 warning")
    session.locator(".choose").click()
    expect(page.locator("#session .note.warn")).to_have_text("the rig has moved")
    shot(page, "warnings")


def videos(page):
    """Looks at the images of a film one by one."""
    page.goto(address)
    film = run(page, FILM)
    page.click("#tab-sessions")
    page.locator(f"#sessions .choose[title='{film}']").click()
    which = page.locator("#session .images")
    expect(which).to_contain_text("1 of 5")
    readout = page.locator("#session .readout")
    page.locator("#session canvas.image").focus()
    page.keyboard.press("ArrowDown")
    expect(readout).to_contain_text("row 25, column 16")
    first = readout.text_content()
    page.locator("#session .images input").focus()
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    expect(which).to_contain_text("5 of 5")
    expect(which).to_contain_text("5 of 5: cycle 4")
    # The same pixel in other frames has other noise.
    expect(readout).not_to_have_text(first)
    expect(readout).to_contain_text("row 25, column 16")
    shots(page, "film")


def earlier_picture(page):
    """A run without live pictures leaves that of the run before, which stays marked when it has ended."""
    page.goto(address)
    about = page.locator("#live-about")
    run(page, FILM)
    expect(about).to_contain_text("px")
    expect(about).not_to_contain_text("of an earlier run")
    run(page, DARKS)
    expect(page.locator("#state")).to_have_text("idle")
    expect(about).to_contain_text("of an earlier run")


def many_tabs(context):
    """Tabs that are not seen hold none of the six connections that a browser has to an address."""
    tabs = [context.new_page() for _ in range(8)]
    for tab in tabs:
        tab.goto(address)
        expect(tab.locator("#state")).to_have_text("idle")
        tab.evaluate("""() => {
            Object.defineProperty(document, "hidden", { configurable: true, get: () => true });
            document.dispatchEvent(new Event("visibilitychange"));
        }""")
    # When it is seen again, it hears what happens.
    first = tabs[0]
    first.evaluate("""() => {
        delete document.hidden;
        document.dispatchEvent(new Event("visibilitychange"));
    }""")
    run(first, plan)
    for tab in tabs:
        tab.close()


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
    has_thumbnail(page)
    picture = page.locator("#session canvas.image").first
    expect(picture).to_be_visible()
    picture.focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#session .u-wrap")).to_be_visible()
    page.locator("#sessions li", has_text="groove").nth(1).get_by_role("button", name="compare").click()
    expect(page.locator("#session h3").nth(0)).to_contain_text("1 = a white pixel lit by its own projector row")
    expect(page.locator("#session h3").nth(2)).to_contain_text("RMS")
    expect(page.locator("#session .differences th")).to_have_count(3)
    expect(page.locator("#session .differences tr", has_text="kind")).to_have_count(0)
    expect(page.locator("#session canvas.image")).to_have_count(3)
    page.locator("#session canvas.image").first.focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#session .u-legend .u-series")).to_have_count(3)
    fits(page, name)
    shot(page, f"sessions-{name}")


with sync_playwright() as playwright:
    browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
    complaints = []
    for turn, (scheme, width) in enumerate(zip(SCHEMES, WIDTHS)):
        context = browser.new_context(color_scheme=scheme, viewport={"width": width, "height": 900})
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        if turn == 0:
            first_visit(page)
            viewfinder(page)
            questions(page)
            warnings(page)
            dot_rig(page)
            videos(page)
            earlier_picture(page)
            many_tabs(context)
        visit(page, f"{scheme}-{width}")
        context.close()
    browser.close()
    assert not complaints, complaints
