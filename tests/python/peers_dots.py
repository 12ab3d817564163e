#!/usr/bin/env python3
"""Times NumPy, SciPy and OpenCV at the dot rig's stages, for `cargo xtask bench dots --peers`.

    python3 -m venv VENV && VENV/bin/pip install -r tests/python/peers-dots-requirements.txt
    VENV/bin/python tests/python/peers_dots.py FOLDER

FOLDER holds frames, the columns of a batch and of its calibration plane, and what the products need, as the bench wrote
them. Each stage is done as a careful user of these packages would: whole arrays at a time, sparse matrices for columns.
Loading and what is computed once for all batches happen before the clock starts. Prints one JSON line for each stage:
least seconds of some repetitions, of a frame or of a batch.
"""

import json
import pathlib
import sys
import time

import cv2
import numpy as np
import scipy.sparse

FALSE_ALARM_SIGMAS = 5.33
MOST_DISCS = 64


def load(folder, name):
    return np.load(folder / f"{name}.npy")


def columns(folder, name, pixels):
    """The sparse part of a batch, [dots, pixels], and its residual, [dots, block rows, block columns]."""
    offsets, words, masks = (load(folder, f"{name}_{part}") for part in ("word_offsets", "words", "masks"))
    bits = np.unpackbits(masks.view(np.uint8).reshape(-1, 4), axis=1, bitorder="little").astype(bool)
    pixel = (words[:, None].astype(np.int64) * 32 + np.arange(32))[bits]
    first = np.concatenate([[0], np.cumsum(bits.sum(1))])[offsets.astype(np.int64)]
    values = load(folder, f"{name}_values")
    sparse = scipy.sparse.csr_matrix((values, pixel, first), shape=(len(offsets) - 1, pixels))
    return sparse, load(folder, f"{name}_residual")[..., 0]


class Denoiser:
    """Dark level, flat field, hot pixels and background, then Algorithm 1."""

    def __init__(self, settings, shape, hot):
        self.radius = settings["radius_px"]
        self.background = np.full(shape, settings["background"], np.float32)
        self.gain = np.broadcast_to((0.9 + 1e-4 * np.arange(shape[0], dtype=np.float32))[:, None], shape).copy()
        self.hot = np.unravel_index(hot, shape)
        self.rounded = np.round(self.background).astype(np.int16)
        self.limit = 0.3 + FALSE_ALARM_SIGMAS * settings["noise"]
        self.y, self.x = np.mgrid[: shape[0], : shape[1]]
        reach = int(np.ceil(self.radius)) - 1
        down, right = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        self.reach, self.disc = reach, down**2 + right**2 < self.radius**2

    def as_printed(self, frame):
        """The paper's text, line by line: corrected float frames, full-frame masks and statistics for every disc."""
        image = (frame - self.background) * self.gain
        blurred = cv2.medianBlur(image, 3)
        image[self.hot] = blurred[self.hot]
        out = np.zeros_like(image)
        for _ in range(MOST_DISCS):
            y, x = np.unravel_index(np.argmax(image), image.shape)
            mean, sigma = image.mean(), image.std()
            if image[y, x] < self.limit:
                break
            disc = np.hypot(self.y - y, self.x - x) < self.radius
            out[disc] += image[disc]
            image[disc] = 0
        return scipy.sparse.csr_matrix(out.reshape(1, -1)), mean, sigma

    def tuned(self, frame):
        """Detection in whole counts, discs cut out in place, corrections for what is taken, sums of blocks."""
        difference = frame.astype(np.int16) - self.rounded
        difference[self.hot] = np.iinfo(np.int16).min
        taken = np.zeros(frame.shape, bool)
        blocks = cv2.resize(
            frame.astype(np.float32) - self.background, None, fx=1 / 32, fy=1 / 32, interpolation=cv2.INTER_AREA
        )
        for _ in range(MOST_DISCS):
            y, x = divmod(int(difference.argmax()), frame.shape[1])
            if difference[y, x] < self.limit:
                break
            top, left = max(y - self.reach, 0), max(x - self.reach, 0)
            part = np.s_[top : y + self.reach + 1, left : x + self.reach + 1]
            rows, cols = difference[part].shape
            disc = self.disc[top - y + self.reach :, left - x + self.reach :][:rows, :cols]
            difference[part][disc] = np.iinfo(np.int16).min
            taken[part] |= disc
        pixels = np.flatnonzero(taken)
        values = (frame.flat[pixels] - self.background.flat[pixels]) * self.gain.flat[pixels]
        return pixels, values, blocks


def synchronise(frames, region):
    """Energies of the region and the trailing dot's frames."""
    energies = frames[(slice(None), *region)].sum((1, 2), dtype=np.int64)
    lit = energies > 1 << 20
    return np.flatnonzero(lit[1:] & ~lit[:-1])


def spread(blocks):
    return np.repeat(np.repeat(blocks, 32, axis=-2), 32, axis=-1)


def relight(sparse, residual, binary, weights):
    """Weighted sums; each pixel of a mask has its value instead of its block's mean."""
    image = weights.T @ sparse
    means = np.einsum("nc,nyx->cyx", weights, residual, optimize=True)
    masked = spread_in_masks(residual, binary)
    return image + spread(means).reshape(weights.shape[1], -1) - weights.T @ masked


def spread_in_masks(residual, binary):
    width = residual.shape[2] * 32
    row, column = np.divmod(binary.indices, width)
    dot = np.repeat(np.arange(binary.shape[0]), np.diff(binary.indptr))
    means = residual[dot, row // 32, column // 32]
    return scipy.sparse.csr_matrix((means, binary.indices, binary.indptr), shape=binary.shape)


def shadow_dot(sparse, light):
    """L_max and L_min over images without one dot."""
    dots = sparse.shape[0]
    largest, least = sparse.max(axis=0).toarray()[0], sparse.min(axis=0).toarray()[0]
    return largest - least, (light - largest) * dots / (dots - 1)


def shadow_neighbours(sparse, by_pixel, light, neighbours):
    """All dots that overlap the pixel's brightest one switched off."""
    dots = sparse.shape[0]
    brightest = np.asarray(sparse.argmax(axis=0)).ravel()
    pixel = np.repeat(np.arange(by_pixel.shape[0]), np.diff(by_pixel.indptr))
    off = by_pixel.data * neighbours[brightest[pixel], by_pixel.indices]
    off = np.bincount(pixel, weights=off, minlength=by_pixel.shape[0])
    counts = neighbours.sum(1)[brightest]
    indirect = (light - off) * dots / (dots - counts)
    return light - indirect, indirect


def epipolar(sparse, light, lines, width, settings):
    """Masks by the distance from each dot's line, at the pixels of its column."""
    dot = np.repeat(np.arange(sparse.shape[0]), np.diff(sparse.indptr))
    row, column = np.divmod(sparse.indices, width)
    line = lines[dot]
    distance = np.abs(line[:, 0] * column + line[:, 1] * row + line[:, 2]) / np.hypot(line[:, 0], line[:, 1])
    beyond = np.maximum(distance - settings["distance_px"], 0)
    share = np.exp(-0.5 * (beyond / settings["sigma_px"]) ** 2)
    direct = np.bincount(sparse.indices, weights=sparse.data * share, minlength=sparse.shape[1])
    return direct, light - direct


def dual(sparse, residual, centroids, energies, size):
    """Columns' sums at their centroids, holes filled from the rim inwards."""
    light = (np.asarray(sparse.sum(axis=1)).ravel() + residual.sum((1, 2)) * 1024) / energies
    image, known = np.zeros((size, size), np.float32), np.zeros((size, size), np.float32)
    x, y = np.round(centroids).astype(int).T
    image[y, x], known[y, x] = light, 1
    kernel = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32)
    while not known.all():
        count = cv2.filter2D(known, -1, kernel, borderType=cv2.BORDER_CONSTANT)
        total = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_CONSTANT)
        rim = (known == 0) & (count > 0)
        image[rim], known[rim] = total[rim] / count[rim], 1
    return image


def confusion(plane):
    """Binarised at half of each column's peak, then all dot products."""
    peaks = plane.max(axis=1).toarray().ravel()
    above = plane.data >= 0.5 * np.repeat(peaks, np.diff(plane.indptr))
    binary = scipy.sparse.csr_matrix((above.astype(np.float32), plane.indices.copy(), plane.indptr.copy()), plane.shape)
    binary.eliminate_zeros()
    return binary @ binary.T


def main(folder):
    settings = json.loads((folder / "settings.json").read_text())
    frames, hot = load(folder, "frames"), load(folder, "hot")
    size = frames.shape[1]
    plane, _ = columns(folder, "plane", size * size)
    sparse, residual = columns(folder, "scene", size * size)
    binary = sparse.copy()
    binary.data[:] = 1
    weights, centroids, energies = (load(folder, name) for name in ("weights", "centroids", "energies"))
    lines = load(folder, "lines")
    by_pixel = sparse.T.tocsr()
    neighbours = confusion(plane).toarray() > 0
    ones = np.ones((sparse.shape[0], 1), np.float32)
    light = relight(sparse, residual, binary, ones)[0]
    cover = np.maximum(light / light.max(), 0.1)
    denoiser = Denoiser(settings, frames.shape[1:], hot)
    region = np.s_[: size // 16, size - size // 16 :]

    def measure(stage, method, run, repetitions=3, of=1):
        run()
        seconds = []
        for _ in range(repetitions):
            began = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - began)
        print(json.dumps({"stage": stage, "method": method, "seconds": min(seconds) / of}), flush=True)

    denoise = "a+c correct and denoise"
    measure(denoise, "NumPy, as printed", lambda: [denoiser.as_printed(frame) for frame in frames[:8]], of=8)
    measure(denoise, "NumPy and OpenCV, tuned", lambda: [denoiser.tuned(frame) for frame in frames], of=len(frames))
    measure("b synchronise", "NumPy", lambda: synchronise(frames, region), of=len(frames))
    measure("d confusion", "scipy.sparse", lambda: confusion(plane))
    measure("f floodlit", "scipy.sparse", lambda: relight(sparse, residual, binary, ones))
    measure("f relight RGB", "scipy.sparse", lambda: relight(sparse, residual, binary, weights))
    measure("g shadow dot", "scipy.sparse", lambda: shadow_dot(sparse, light))
    measure("g shadow neighbours", "SciPy and NumPy", lambda: shadow_neighbours(sparse, by_pixel, light, neighbours))
    measure("h epipolar mask", "NumPy", lambda: epipolar(sparse, light, lines, size, settings))
    measure("i dual", "SciPy and OpenCV", lambda: dual(sparse, residual, centroids, energies, size))
    measure("j overlap", "NumPy", lambda: light / cover)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(pathlib.Path(sys.argv[1]))
