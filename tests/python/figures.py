"""Makes figures 5 to 11 of Kubo et al. (ICCP 2018) on the simulated rig: figures.py PROGRAMS SCENES ROOT FOLDER

PROGRAMS holds raysweepd and raysweep, SCENES the true transport of the built-in scenes (`sim/examples/scenes.rs`), ROOT is
the checkout, and FOLDER gets the sessions and one page, index.html. Every number on the page compares what a session holds
with the true transport through NumPy alone, which shares no code with the simulator or the solver. Ends with exit code 1 if
a figure misses its bound.
"""

import base64
import html
import json
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np

PROGRAMS, SCENES, ROOT, FOLDER = (Path(argument).resolve() for argument in sys.argv[1:5])
PLANS = ROOT / "docs/plane"
ROW_TIME_US = 22.22
# The rig of the README, before another scene.
RIG = (ROOT / "deploy/rigs/patterns-sim.toml").read_text()


class Lab:
    """A daemon with a rig, as long as the block lasts."""

    def __init__(self, name, scene, rows=128):
        self.name, self.scene, self.rows = name, scene, rows

    def __enter__(self):
        text = RIG.replace('scene = "candle"', f"scene = {json.dumps(str(self.scene))}")
        text = text.replace("rows = 128", f"rows = {self.rows}")
        assert str(self.scene) in text
        self.folder = FOLDER / self.name
        self.folder.mkdir(parents=True)
        (self.folder / "rig.toml").write_text(text)
        self.socket = self.folder / "socket"
        arguments = ["--rig", self.folder / "rig.toml", "--socket", self.socket, "--data", self.folder / "sessions"]
        log = (self.folder / "raysweepd.log").open("w")
        self.process = subprocess.Popen([PROGRAMS / "raysweepd", *arguments], stderr=log)
        while not self.socket.exists() and self.process.poll() is None:
            time.sleep(0.05)
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait()

    def run(self, plan):
        """Runs a plan; returns its session."""
        raysweep("--socket", self.socket, "run", plan)
        return max((self.folder / "sessions").iterdir(), key=lambda folder: folder.stat().st_ctime)


def raysweep(*arguments, json_answer=False):
    words = [PROGRAMS / "raysweep", *(["--json"] if json_answer else []), *arguments]
    done = subprocess.run([str(word) for word in words], stdout=subprocess.PIPE, check=True, text=True)
    return json.loads(done.stdout) if json_answer else done.stdout


def product(session, name):
    return np.load(session / "products" / f"{name}.npy").astype(float)


def about(session, name):
    return json.loads((session / "products" / f"{name}.json").read_text())


# The truth, through NumPy alone.


def true_transport(name):
    """T [v, t, s] of a built-in scene."""
    return np.load(SCENES / f"{name}.npz")["T"].astype(float)


def seen(transport, delay_us, exposure_us):
    """The image of a rolling shutter, 1 for a white pixel under its own row: row t is exposed for exposure_us about the
    middle of the light of projector row t plus delay_us."""
    rows = transport.shape[0]
    begins = (np.arange(rows) + 0.5) * ROW_TIME_US + delay_us - exposure_us / 2
    light = np.arange(rows) * ROW_TIME_US
    overlap = np.minimum(begins[None] + exposure_us, light[:, None] + ROW_TIME_US) - np.maximum(begins[None], light[:, None])
    weights = np.clip(overlap, 0, None) / ROW_TIME_US
    return np.einsum("vt,vts->ts", weights, transport)


def own_row(transport):
    t = np.arange(transport.shape[1])
    return transport[t, t, :]


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def error(image, truth):
    """Root mean square of the difference, as a share of that of the truth."""
    return rms(image - truth) / rms(truth)


# The page.


def png(image, white=None, zoom=2):
    """An image element of a linear image."""
    white = white or np.percentile(image, 99.5) or 1.0
    grey = np.clip(np.nan_to_num(image) / white, 0, 1) ** (1 / 2.2)
    grey = np.kron(np.round(255 * grey).astype(np.uint8), np.ones((zoom, zoom), np.uint8))
    rows, columns = grey.shape
    raw = b"".join(b"\0" + row.tobytes() for row in grey)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(raw, 9)) + chunk(b"IEND", b"")
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(data).decode()}">'


def picture(caption, image, white=None, zoom=2):
    return f"<figure>{png(image, white, zoom)}<figcaption>{html.escape(caption)}</figcaption></figure>"


COLOURS = ["#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377"]


def plot(x_label, y_label, curves):
    """Curves (name, x, y, standard deviation or None) as SVG, with one scale from 0."""
    width, height, left, right, bottom = 640, 300, 80, 30, 40
    xs = np.concatenate([curve[1] for curve in curves])
    low, high, top = xs.min(), xs.max(), max(np.max(curve[2]) for curve in curves) * 1.05

    def at(x, y):
        across = left + (np.asarray(x) - low) / (high - low) * (width - left - right)
        return across, (height - bottom) - np.asarray(y) / top * (height - bottom - 10)

    parts = [f'<svg viewBox="0 0 {width} {height + 18 * len(curves)}" width="{width}">']
    for value in np.linspace(low, high, 7):
        x, _ = at(value, 0)
        parts.append(f'<text x="{x:.1f}" y="{height - bottom + 16}" text-anchor="middle">{value:.4g}</text>')
    for value in np.linspace(0, top, 5):
        _, y = at(low, value)
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.3g}</text>')
        parts.append(f'<path d="M{left} {y:.1f}H{width - right}" stroke="#8884" fill="none"/>')
    middle = (height - bottom) / 2
    parts.append(f'<text x="{width / 2}" y="{height - 6}" text-anchor="middle">{x_label}</text>')
    parts.append(f'<text transform="translate(12 {middle}) rotate(-90)" text-anchor="middle">{y_label}</text>')
    for number, (name, x, y, deviation) in enumerate(curves):
        colour = COLOURS[number % len(COLOURS)]
        if deviation is not None:
            above, below = at(x, y + deviation), at(x, np.maximum(y - deviation, 0))
            outline = [*zip(*above), *reversed([*zip(*below)])]
            points = " ".join(f"{a:.1f},{b:.1f}" for a, b in outline)
            parts.append(f'<polygon points="{points}" fill="{colour}" opacity="0.25"/>')
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(*at(x, y)))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        parts.append(f'<text x="{left}" y="{height + 14 + 18 * number}" style="fill:{colour}">{html.escape(name)}</text>')
    return "".join(parts) + "</svg>"


class Page:
    def __init__(self):
        self.parts, self.missed = [], []

    def figure(self, number, title, text, pictures, checks, plans):
        """Appends a figure. Checks are (what, found, bound, whether the bound is the most)."""
        rows = []
        for what, found, bound, at_most in checks:
            is_met = found <= bound if at_most else found >= bound
            if not is_met:
                self.missed.append(f"figure {number}: {what}: {found:.4g}")
            sign = "at most" if at_most else "at least"
            mark = "" if is_met else ' class="missed"'
            rows.append(f"<tr{mark}><td>{html.escape(what)}</td><td>{found:.4g}</td><td>{sign} {bound:g}</td></tr>")
            print(f"figure {number}: {what}: {found:.4g} ({sign} {bound:g})")
        links = ", ".join(f"<code>{plan}</code>" for plan in plans)
        self.parts.append(
            f"<section><h2>Figure {number}: {html.escape(title)}</h2><p>{html.escape(text)} Plans: {links}.</p>"
            f'<div class="pictures">{"".join(pictures)}</div>'
            f"<table><tr><th>against the truth</th><th>found</th><th>bound</th></tr>{''.join(rows)}</table></section>"
        )

    def write(self, path):
        style = (
            ":root{color-scheme:light dark}body{font:16px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;}"
            ".pictures{display:flex;flex-wrap:wrap;gap:1rem}figure{margin:0}.row{display:flex;gap:.3rem}figcaption{max-width:16rem;font-size:.85rem}"
            "img{image-rendering:pixelated;max-width:100%}svg{font-size:12px;max-width:100%}svg text{fill:currentColor}"
            "td,th{text-align:left;padding:.1rem 1rem .1rem 0}.missed{color:#c00;font-weight:bold}"
        )
        head = "<h1>The figures of plane-to-ray light transport, on the simulated rig</h1>"
        intro = (
            "<p>Figures 5 to 11 of Kubo et al., <cite>Acquiring and Characterizing Plane-to-Ray Indirect Light Transport</cite> "
            "(ICCP 2018), with built-in scenes in place of theirs: 128 x 128 pixels at 12 bit with shot and read noise, projector "
            "rows of 22.22 µs. 1 is a white pixel under its own row. Made by <code>cargo xtask figures</code>.</p>"
        )
        page = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Figures</title><style>{style}</style>'
        path.write_text(f"{page}{head}{intro}{''.join(self.parts)}</html>\n")


def stack(page):
    truth = true_transport("mirror-ball")
    with Lab("ball", "mirror-ball") as lab:
        session = lab.run(PLANS / "stack.toml")
    shown = [
        ("(a) regular", product(session, "regular"), truth.sum(axis=0)),
        ("(b) epipolar: delay 0, exposure 450 µs", product(session, "captured_0us_450us"), seen(truth, 0, 450)),
        ("(c) indirect: delay 800 µs, exposure 450 µs", product(session, "captured_800us_450us"), seen(truth, 800, 450)),
        ("(d) indirect: delay 800 µs, exposure 1200 µs", product(session, "captured_800us_1200us"), seen(truth, 800, 1200)),
    ]
    # Highlights saturate.
    known = product(session, "regular") < 0.99 * product(session, "regular").max()
    checks = [(f"RMS error of {what}", error(image[known], true[known]), 0.05, True) for what, image, true in shown]
    page.figure(5, "bands of indirect light", "A mirror ball in a corner.", [picture(what, image) for what, image, _ in shown],
                checks, ["docs/plane/stack.toml"])
    rows, worst, all_light = [], 0.0, rms(truth.sum(axis=0)[known])
    for exposure_us in [450, 600, 1200]:
        film, delays_us = product(session, f"captured_{exposure_us}us"), about(session, f"captured_{exposure_us}us")["k"]["at"]
        white = np.percentile(film, 99.5)
        for delay_us, image in zip(delays_us, film):
            worst = max(worst, rms((image - seen(truth, delay_us, exposure_us))[known]) / all_light)
        shown = [picture(f"{round(delay_us)}, {exposure_us}", image, white, 1) for delay_us, image in zip(delays_us, film)]
        rows.append(f'<div class="row">{"".join(shown[::2])}</div>')
    page.figure(6, "the stack over delay and exposure", "From left to right the delay, from top to bottom the exposure; every second delay is shown.",
                rows, [("worst RMS difference of the 51 images, as a share of the regular image", worst, 0.02, True)], ["docs/plane/stack.toml"])


def profiles(page):
    truth = true_transport("mix")
    with Lab("mix", "mix") as lab:
        session = lab.run(PLANS / "profiles.toml")
    curves, checks = [], []
    marked = product(session, "regular")
    for name, pixel in [("candle", (88, 96)), ("groove", (30, 30)), ("matt", (104, 122))]:
        table, columns = product(session, name), about(session, name)["columns"]
        delays_us, light = table[:, columns.index("delay_us")], table[:, columns.index("light")]
        region = tuple(slice(middle - 2, middle + 3) for middle in pixel)
        true = np.array([seen(truth, delay_us, 200)[region].mean() for delay_us in delays_us])
        curves.append((f"{name} {pixel}", delays_us, light / np.trapezoid(light, delays_us), None))
        checks.append((f"RMS error of the profile of {name}", error(light, true), 0.02, True))
        marked[pixel[0] - 3 : pixel[0] + 4, pixel[1]] = marked[pixel[0], pixel[1] - 3 : pixel[1] + 4] = marked.max()
    page.figure(7, "delay profiles", "The light of 5 x 5 pixels over the delay at an exposure of 200 µs, each divided by its area: a candle, a groove, and a matt card.",
                [picture("regular; the crosses are in the regions", marked), plot("delay t_d / µs", "light / area / µs⁻¹", curves)], checks, ["docs/plane/profiles.toml"])


def sharpened(page):
    truth = true_transport("candle")
    line = 64
    with Lab("candle", "candle") as lab:
        session = lab.run(PLANS / "sharpen.toml")
        short, long = lab.run(PLANS / "line-1.toml"), lab.run(PLANS / "line-48.toml")
    regular, captured, epipolar = (product(session, name) for name in ["regular", "captured_0us_600us", "epipolar"])
    direct = own_row(truth)
    raw_error, sharp_error = error(captured, direct), error(epipolar, direct)
    section, columns = product(session, "cross_section_t64"), about(session, "cross_section_t64")["columns"]
    curves = [(name, section[:, 0], section[:, columns.index(name)], None) for name in ["regular", "captured", "sharpened"]]
    curves.append(("true u = 0", section[:, 0], direct[line], None))
    page.figure(8, "the sharpened epipolar image", "A candle. The epipolar image as captured contains the light that spreads below its surface.",
                [picture("(a) regular", regular), picture("(b) captured, 600 µs", captured), picture("(c) sharpened", epipolar),
                 plot("(d) s / pixels", "light", curves)],
                [("RMS error of the sharpened image", sharp_error, 0.05, True),
                 ("error of the captured image over that of the sharpened", raw_error / sharp_error, 20, False)],
                ["docs/plane/sharpen.toml"])
    compared = FOLDER / "relit"
    told = raysweep("relit", session, short, long, "--to", compared, json_answer=True)[0]
    relit, true = np.load(compared / f"{told['name']}.npy").astype(float), truth[line]
    single, many = product(short, f"line-{line}-regular"), product(long, f"line-{line}-regular")
    film = product(session, "line")
    white = np.percentile(true, 99.5)
    decibel = {what: 20 * np.log10(1 / error(image, true)) for what, image in [("relit", relit), ("16", single), ("800", many)]}
    page.figure(9, "relighting by a line", "The candle under one projector row: from the stack of the sweep, and as captured.",
                [picture(f"(a) to (d): row {first}", film[k], white) for k, first in [(8, 32), (12, 48), (16, 64), (20, 80)]]
                + [picture("(e) regular", regular), picture("(f) relit, row 64", relit, white), picture("(g) captured in 16 ms", single, white),
                   picture("(h) captured in 800 ms", many, white)],
                [("SNR of the relit image, dB", decibel["relit"], 25, False),
                 ("SNR of the relit image over that of 16 ms, dB", decibel["relit"] - decibel["16"], 10, False),
                 ("SNR of 800 ms over that of the relit image, dB", decibel["800"] - decibel["relit"], 2, True)],
                ["docs/plane/sharpen.toml", "docs/plane/line-1.toml", "docs/plane/line-48.toml"])


def separated(page):
    with Lab("groove", "v-groove") as lab:
        session = lab.run(ROOT / "deploy/plans/patterns.toml")
    truth = true_transport("v-groove")
    names = ["direct", "global", "epipolar-direct", "epipolar-global", "non-epipolar"]
    images = {name: product(session, name) for name in names}
    total, epipolar = images["direct"] + images["global"], images["epipolar-direct"] + images["epipolar-global"]
    white = np.percentile(total, 99.5)
    # Direct light lies in the pixel's own row, and so does some of the rest.
    most = own_row(truth)
    page.figure(10, "direct and global light", "A groove under 128 shifted checkerboards, with and without the gate of 600 µs.",
                [picture("(a) all light", total, white), picture("(b) direct, by the checkerboards", images["direct"], white),
                 picture("(c) epipolar, by the gate", epipolar, white), picture("(d) epipolar and direct", images["epipolar-direct"], white),
                 picture("(e) epipolar and global, 4 times brighter", images["epipolar-global"], white / 4),
                 picture("non-epipolar, 4 times brighter", images["non-epipolar"], white / 4)],
                [("RMS error of direct + global", error(total, truth.sum(axis=0)), 0.03, True),
                 ("RMS error of epipolar direct + global", error(epipolar, seen(truth, 0, 600)), 0.03, True),
                 ("mean of epipolar-direct over that of u = 0", float(images["epipolar-direct"].mean() / most.mean()), 1.02, True)],
                ["deploy/plans/patterns.toml"])


# A render of media: height of a row in mm, exposures, rows and columns of each container, its first row, labels from the left.
MEDIA = {
    "media_first": (0.25, [200, 400, 800], (40, 20), 4, ["lowfat milk", "reduced milk", "regular milk", "soap", "toothpaste"]),
    "media_second": (0.3, [200, 400, 800], (36, 18), 7, ["soap", "regular milk", "lowfat milk", "toothpaste", "reduced milk"]),
    "media_third": (0.27, [150, 300, 600], (38, 20), 5, ["toothpaste", "lowfat milk", "soap", "reduced milk", "ketchup", "regular milk"]),
}


def media(page):
    sessions, labels, curves, checks = [], [], [], []
    for name, (mm_per_row, exposures_us, (rows, columns), first_row, materials) in MEDIA.items():
        scene = ROOT / "tests/data" / f"{name}.npz"
        with Lab(name, scene, rows=48) as lab:
            plan = lab.folder / "plan.toml"
            text = (PLANS / "media.toml").read_text().replace("mm_per_row = 0.25", f"mm_per_row = {mm_per_row}")
            plan.write_text(text.replace("[200, 400, 800]", str(exposures_us)))
            session = lab.run(plan)
        text = ""
        for at, material in enumerate(materials):
            first = 1 + at * (columns + 2)
            region = [first_row, first_row + rows, first, first + columns]
            text += f'[[region]]\nlabel = "{material}"\nregion = {region}\n'
        file = FOLDER / name / "labels.toml"
        file.write_text(text)
        sessions.append(session)
        labels.append(file)
    truth, transport = np.load(ROOT / "tests/data/media_first.npz")["T"].astype(float), np.load(sessions[0] / "products/transport.npy")
    u_min = about(sessions[0], "transport")["u_min"]
    _, _, (rows, columns), first_row, materials = MEDIA["media_first"]
    for at, material in enumerate(materials):
        first = 1 + at * (columns + 2)
        t, inside = first_row + rows // 2, slice(first + 3, first + columns - 3)
        u = np.arange(-min(t, -u_min), min(47 - t, u_min + len(transport) - 1) + 1)
        found = transport[u - u_min, t, inside].mean(axis=1)
        spread = transport[u - u_min, t, inside].std(axis=1)
        true = truth[t + u, t, inside].mean(axis=1)
        curves.append((material, u * ROW_TIME_US, found / found.sum(), spread / found.sum()))
        checks.append((f"RMS error of the profile of {material}", error(found / found.sum(), true / true.sum()), 0.05, True))
    model = FOLDER / "model.json"
    labelled = [word for file in labels[:2] for word in ("--labels", file)]
    raysweep("materials", "train", *sessions[:2], *labelled, "--to", model)
    told = raysweep("materials", "evaluate", sessions[2], "--labels", labels[2], "--model", model, "--to", FOLDER / "evaluation", json_answer=True)
    shown = ""
    for judged in told["judged"]:
        if judged["at_edges"]:
            continue
        counts = np.array(judged["counts"], float)
        shares = counts / counts.sum(axis=1, keepdims=True)
        known = len(told["materials"])
        checks.append((f"worst share found rightly, {judged['window_px']} x {judged['window_px']} pixels", float(np.diag(shares[:known]).min()), 0.91, False))
        names = told["materials"] + told["strangers"]
        head = "".join(f"<th>{html.escape(name)}</th>" for name in [*told["materials"], "unknown"])
        lines = "".join(f"<tr><th>{html.escape(name)}</th>{''.join(f'<td>{share:.3f}</td>' for share in row)}</tr>" for name, row in zip(names, shares))
        shown += f"<table><tr><th>{judged['window_px']} x {judged['window_px']} pixels</th>{head}</tr>{lines}</table>"
    page.figure(11, "materials", "Five media in one render, and where a model that was trained on two others finds them in a third; ketchup is unknown to it.",
                [picture("(a) regular", product(sessions[0], "regular"), zoom=4), plot("(b) delay t_d / µs", "share of the light", curves), shown],
                checks, ["docs/plane/media.toml"])


def main():
    page = Page()
    for figure in [stack, profiles, sharpened, separated, media]:
        figure(page)
    page.write(FOLDER / "index.html")
    for missed in page.missed:
        print(f"MISSED {missed}", file=sys.stderr)
    sys.exit(1 if page.missed else 0)


main()
