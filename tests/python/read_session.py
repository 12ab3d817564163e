#!/usr/bin/env python3
"""Reads every file of a session with packages that know nothing of raysweep, and checks that the files agree.

    python3 -m venv VENV && VENV/bin/pip install -r tests/python/requirements.txt
    VENV/bin/python tests/python/read_session.py SESSION_FOLDER...

Exits with 0 where all holds, and with 1 and one line a fault where something does not.
"""

import csv
import hashlib
import json
import pathlib
import sys
import tomllib
import zlib
from html.parser import HTMLParser

import numpy as np
import OpenEXR
import zarr

ATTRIBUTE_PREFIX = "raysweep."


class Faults:
    """Collects what does not hold, and counts what was checked."""

    def __init__(self):
        self.checked = 0
        self.found = []

    def check(self, holds, what):
        self.checked += 1
        if not holds:
            self.found.append(what)

    def equal(self, found, expected, what):
        self.check(found == expected, f"{what}: {found!r}, expected {expected!r}")

    def same_array(self, found, expected, what):
        same = (
            found.shape == expected.shape
            and found.dtype == expected.dtype
            and np.array_equal(found, expected, equal_nan=True)
        )
        self.check(same, f"{what}: {found.dtype}{found.shape} differs from {expected.dtype}{expected.shape}")


def read_ledger(faults, session):
    """All lines; each has a checksum of itself and of the checksum before it."""
    lines = (session / "ledger.jsonl").read_bytes().splitlines()
    before = b""
    for number, line in enumerate(lines, start=1):
        entry, _, found = line.removesuffix(b'"}').rpartition(b',"chain":"')
        digits = hashlib.sha256(before + entry).hexdigest()[:16].encode()
        faults.equal(found, digits, f"chain of line {number} of the ledger")
        before = found
    return [json.loads(line) for line in lines]


def check_ledger(faults, entries):
    """The first line, and that every trigger is accounted for."""
    header = entries[0]
    faults.equal(header["event"], "session", "first line of the ledger")
    faults.equal(header["format"], 2, "format of the ledger")
    faults.check(all(entry["event"] != "session" for entry in entries[1:]), "a second `session` line")
    for number, entry in enumerate(entries, start=1):
        if counts := entry.get("counts"):
            parts = [counts[name] for name in ("averaged", "settling", "cancelled")]
            total = sum(parts) + sum(counts["lost"].values())
            faults.equal(total, counts["expected"], f"accounting in line {number} of the ledger")
    return header


def check_stack(faults, session, header, entries):
    """Shapes, types, names of axes, and the checksum of every stored point."""
    group = zarr.open_group(session / "stack.zarr", mode="r", zarr_format=3)
    shape = header["shape"]
    frame = (shape["rows"], shape["columns"])
    expected = {
        "sum": ((shape["points"], *frame), ("point", "t", "s")),
        "dark": ((shape["exposures"], *frame), ("exposure", "t", "s")),
        "clipped": ((shape["points"], *frame), ("point", "t", "s")),
        "regular": ((1, *frame), ("frame", "t", "s")),
    }
    if header["kind"] == "film":
        expected = {"dark": expected["dark"]}
    faults.equal(sorted(group.array_keys()), sorted(expected), "arrays of stack.zarr")
    faults.equal(group.attrs["kind"], header["kind"], "kind of stack.zarr")
    stored = {(entry["array"], entry["index"]): entry for entry in entries if entry["event"] == "point"}
    for name, (array_shape, axes) in expected.items():
        array = group[name]
        faults.equal(array.shape, array_shape, f"shape of {name}")
        faults.equal(array.dtype, np.dtype("uint32"), f"type of {name}")
        faults.equal(array.metadata.dimension_names, axes, f"axes of {name}")
        faults.equal(array.shards[0], 1, f"points in a shard of {name}")
        values = array[:]
        for (array_name, index), entry in stored.items():
            if array_name == name:
                crc32 = zlib.crc32(values[index].astype("<u4").tobytes())
                faults.equal(crc32, entry["crc32"], f"checksum of {name}[{index}]")
                faults.same_array(array[index], values[index], f"{name}[{index}] read alone")


def check_npy(faults, path):
    """C order, float32, and the sidecar; gives the array and the metadata."""
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        _, fortran_order, dtype = read_header(file)
    faults.check(not fortran_order, f"{path.name} is in Fortran order")
    faults.equal(dtype, np.dtype("<f4"), f"type of {path.name}")
    return np.load(path), json.loads(path.with_suffix(".json").read_text())


def check_exr(faults, path, values, metadata):
    """Names and values of the channels, and the metadata in the header."""
    # The file stays open: closing it empties its header.
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header, channels = file.header(), file.channels()
        if layers := metadata.get("layers"):
            expected = {f"{layer}.Y": image for layer, image in zip(layers, values, strict=True)}
        elif values.ndim == 2:
            expected = {"Y": values}
        else:
            expected = {name: values[:, :, index] for index, name in enumerate("RGB")}
        mask = path.with_name(f"{path.stem}_mask.npy")
        if mask.exists():
            expected["mask"] = np.load(mask).astype(np.float32)
        faults.equal(set(channels), set(expected), f"channels of {path.name}")
        faults.equal(header["compression"], OpenEXR.ZIP_COMPRESSION, f"compression of {path.name}")
        faults.equal(header["type"], OpenEXR.scanlineimage, f"storage of {path.name}")
        for name, channel in channels.items():
            faults.same_array(channel.pixels, expected[name], f"{path.name} channel {name} against NPY")
        for key, value in metadata.items():
            text = header.get(ATTRIBUTE_PREFIX + key)
            faults.check(text is not None, f"{path.name} lacks {ATTRIBUTE_PREFIX}{key}")
            if text is not None:
                faults.equal(text if isinstance(value, str) else json.loads(text), value, f"{path.name} {key}")


def check_csv(faults, path, values, metadata):
    """The CSV file has the columns of the metadata and the values of the NPY file."""
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    faults.equal(header, metadata["columns"], f"columns of {path.name}")
    faults.same_array(np.array(rows, dtype=np.float64).astype(np.float32), values, f"{path.name} against NPY")


def check_products(faults, session):
    products = {}
    for path in sorted((session / "products").glob("*.npy")):
        if path.stem.endswith("_mask"):
            faults.equal(np.load(path).dtype, np.dtype("u1"), f"type of {path.name}")
            continue
        values, metadata = check_npy(faults, path)
        products[path.stem] = values, metadata
        exr = path.with_suffix(".exr")
        if exr.exists():
            check_exr(faults, exr, values, metadata)
        table = path.with_suffix(".csv")
        if table.exists():
            check_csv(faults, table, values, metadata)
    for exr in (session / "products").glob("*.exr"):
        faults.check(exr.stem in products, f"{exr.name} has no NPY beside it")
    return products


def check_transport(faults, session, header, products):
    """transport.zarr is transport.npy, and its plane u = 0 is the epipolar image."""
    array = zarr.open_group(session / "transport.zarr", mode="r", zarr_format=3)["transport"]
    volume, metadata = products["transport"]
    faults.equal(array.metadata.dimension_names, ("u", "t", "s"), "axes of transport")
    faults.same_array(array[:], volume, "transport.zarr against transport.npy")
    faults.equal(metadata["axes"], ["u", "t", "s"], "axes in transport.json")
    for key in ("u_min", "u_max"):
        faults.equal(array.attrs[key], metadata[key], f"{key} of transport.zarr against transport.json")
    depth = metadata["u_max"] - metadata["u_min"] + 1
    shape = header["shape"]
    faults.equal(volume.shape, (depth, shape["rows"], shape["columns"]), "shape of transport")
    if "epipolar" in products:
        epipolar, _ = products["epipolar"]
        faults.same_array(epipolar, volume[-metadata["u_min"]], "epipolar.npy against u = 0")


def check_manifest(faults, session, header):
    manifest = json.loads((session / "manifest.json").read_text())
    points = manifest["points"]
    faults.equal(points["planned"], header["shape"]["points"], "points planned")
    faults.equal(points["stored"] + points["missing"], points["planned"], "points stored and missing")
    files = {path.relative_to(session).as_posix(): path for path in session.rglob("*") if path.is_file()}
    del files["manifest.json"]
    faults.equal(sorted(files), sorted(manifest["files"]), "files in the manifest")
    for name, record in manifest["files"].items():
        content = files[name].read_bytes() if name in files else b""
        faults.equal(len(content), record["bytes"], f"size of {name}")
        faults.equal(hashlib.sha256(content).hexdigest(), record["sha256"], f"checksum of {name}")


def check_film(faults, session, header, entries):
    """Shapes, types, names of axes, the checksum of every stored cycle, and a transport for each."""
    film = zarr.open_group(session / "film.zarr", mode="r", zarr_format=3)["film"]
    transport = zarr.open_group(session / "transport_film.zarr", mode="r", zarr_format=3)["transport"]
    shape = header["shape"]
    frame = (shape["rows"], shape["columns"])
    faults.equal(film.shape, (shape["points"], shape["settings"], *frame), "shape of film")
    faults.equal(film.dtype, np.dtype("uint16"), "type of film")
    faults.equal(film.metadata.dimension_names, ("cycle", "setting", "t", "s"), "axes of film")
    depth = transport.attrs["u_max"] - transport.attrs["u_min"] + 1
    faults.equal(transport.shape, (shape["points"], depth, *frame), "shape of the film's transport")
    faults.equal(transport.dtype, np.dtype("float32"), "type of the film's transport")
    faults.equal(transport.metadata.dimension_names, ("cycle", "u", "t", "s"), "axes of the film's transport")
    mask = zarr.open_group(session / "transport_film.zarr", mode="r", zarr_format=3)["mask"]
    faults.equal(mask.shape, transport.shape, "shape of the film's masks")
    faults.equal(mask.dtype, np.dtype("uint8"), "type of the film's masks")
    faults.equal(mask.metadata.dimension_names, ("cycle", "u", "t", "s"), "axes of the film's masks")
    for name, array in (("film", film), ("transport", transport), ("mask", mask)):
        faults.equal(array.shards[0], 1, f"cycles in a shard of {name}")
    cycles = {entry["cycle"]: entry for entry in entries if entry["event"] == "cycle"}
    faults.check(cycles, "no cycle is stored")
    for cycle in range(shape["points"]):
        estimate = transport[cycle]
        if cycle not in cycles:
            faults.check(np.isnan(estimate).all(), f"transport of cycle {cycle}, which is not stored")
            continue
        crc32 = zlib.crc32(film[cycle].astype("<u2").tobytes())
        faults.equal(crc32, cycles[cycle]["crc32"], f"checksum of cycle {cycle}")
        faults.equal(len(cycles[cycle]["delays_us"]), shape["settings"], f"delays of cycle {cycle}")
        faults.check(np.isfinite(estimate).all() and (estimate >= 0).all(), f"transport of cycle {cycle}")


class ReportParser(HTMLParser):
    """Finds what a report would load from elsewhere."""

    def __init__(self):
        super().__init__()
        self.pictures = 0
        self.foreign = []

    def handle_starttag(self, tag, attrs):
        self.pictures += tag in ("img", "svg")
        for name, value in attrs:
            if name in ("src", "href", "xlink:href") and not (value or "").startswith(("data:", "#")):
                self.foreign.append(f"<{tag} {name}={value}>")


def check_report(faults, session):
    parser = ReportParser()
    parser.feed((session / "report.html").read_text())
    faults.check(parser.pictures > 0, "report.html shows nothing")
    faults.check(not parser.foreign, f"report.html is not self-contained: {parser.foreign}")


def check_session(session):
    faults = Faults()
    for name in ("plan.toml", "rig.toml"):
        faults.check("kind" in tomllib.loads((session / name).read_text()), f"{name} names no kind")
    entries = read_ledger(faults, session)
    header = check_ledger(faults, entries)
    check_stack(faults, session, header, entries)
    if header["kind"] == "film":
        check_film(faults, session, header, entries)
    else:
        products = check_products(faults, session)
        check_transport(faults, session, header, products)
    check_manifest(faults, session, header)
    check_report(faults, session)
    return faults


def main(arguments):
    if not arguments:
        sys.exit(__doc__)
    failed = 0
    for argument in arguments:
        faults = check_session(pathlib.Path(argument))
        for fault in faults.found:
            print(f"{argument}: {fault}", file=sys.stderr)
        print(f"{argument}: {faults.checked - len(faults.found)} of {faults.checked} checks hold")
        failed += bool(faults.found)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
