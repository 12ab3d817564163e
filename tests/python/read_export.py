"""Compares the exports of a session with its own NPY files, by the readers that their users have.

read_export.py SESSION FOLDER: FOLDER has an export of each format, by its name.
"""

import io
import json
import re
import sys
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import scipy.io
import tifffile

session, folder = Path(sys.argv[1]), Path(sys.argv[2])
products = {}
for path in sorted((session / "products").glob("*.json")):
    if path.with_suffix(".npy").exists():
        products[path.stem] = (np.load(path.with_suffix(".npy")), json.loads(path.read_text()))
assert products, "no products"


def pictures():
    """Images `[t, s]` and sequences `[k, t, s]`."""
    for name, (values, described) in products.items():
        if described["axes"] in (["t", "s"], ["k", "t", "s"]):
            yield name, values, described


def readme(of):
    if of == "zip":
        archive = zipfile.ZipFile(folder / "zip.zip")
        name, = (name for name in archive.namelist() if name.endswith("README.md"))
        text = archive.read(name).decode()
    else:
        text = (folder / of / "README.md").read_text()
    rows = [re.split(r" \| ", line.strip("| ")) for line in text.splitlines() if line.startswith("| ")]
    return {row[0].strip("`"): row for row in rows}


endings = {"exr": ".exr", "npy": ".npy", "tiff16": ".tiff", "tiff32": ".tiff", "zip": ".npy"}
for of, ending in endings.items():
    rows = readme(of)
    for name, values, described in pictures():
        _, axes, units, *_ = rows[f"{name}{ending}"]
        assert axes == f"`[{', '.join(described['axes'])}]`" and units == described["units"], (of, name, axes, units)

found = 0
for name, values, described in pictures():
    floats = tifffile.imread(folder / "tiff32" / f"{name}.tiff")
    assert floats.dtype == np.float32 and np.array_equal(floats, values), name
    with tifffile.TiffFile(folder / "tiff16" / f"{name}.tiff") as file:
        codes, text = file.asarray(), file.pages[0].description
    scale = float(re.match(r"value = code \* (\S+)", text).group(1))
    assert json.loads(text.split("\n", 1)[1])["axes"] == described["axes"], name
    assert codes.dtype == np.uint16 and codes.shape == values.shape, (name, codes.shape)
    assert np.abs(codes * scale - np.clip(values, 0, None)).max() <= 0.51 * scale, name
    assert float(readme("tiff16")[f"{name}.tiff"][3]) == scale, name
    found += 1
assert found >= 4, found

for name, values, described in pictures():
    channels = OpenEXR.File(str(folder / "exr" / f"{name}.exr")).channels()
    if values.ndim == 2:
        assert np.array_equal(channels["Y"].pixels, values), name
    assert np.array_equal(np.load(folder / "npy" / f"{name}.npy"), values), name
    first = folder / "png" / (f"{name}.png" if values.ndim == 2 else f"{name}/0000.png")
    assert first.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n", name

variables = scipy.io.loadmat(folder / "mat" / "products.mat")
for name, (values, _) in products.items():
    variable = variables[re.sub(r"[^A-Za-z0-9]", "_", name)]
    assert variable.dtype == np.float32 and variable.shape == values.shape, (name, variable.shape)
    assert np.array_equal(variable, values), name

with zipfile.ZipFile(folder / "zip.zip") as archive:
    assert archive.testzip() is None
    for name, (values, _) in products.items():
        assert np.array_equal(np.load(io.BytesIO(archive.read(f"{name}.npy"))), values), name
    assert "report.html" in archive.namelist() and "ledger.jsonl" in archive.namelist()

units = readme("mat")["transport"]
assert units[1] == "`[u, t, s]`" and "white pixel" in units[2], units
print("exports agree")
