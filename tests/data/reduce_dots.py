"""Reduce a rendered still life under flying dots: `reduce_dots.py STILL.npz PLANES.npz OUT_STILL.npz OUT_PLANES.npz`.

Four neighbouring dots become one, colours become their mean, and values are rounded to steps of 2^-13, with the error
carried on to the next dot of the same pixel.
"""

import sys

import numpy as np

SIDE, STEP = 16, 2.0**-13


def main(still, planes, out_still, out_planes):
    still, planes = np.load(still), np.load(planes)
    column, row = np.floor(still["uv"] * SIDE).astype(int).clip(0, SIDE - 1).T
    scan = [(r, c if r % 2 == 0 else SIDE - 1 - c) for r in range(SIDE) for c in range(SIDE)]

    def reduced(images):
        images = images.astype(np.float32)
        sums = np.stack([images[(row == r) & (column == c)].sum(0) for r, c in scan])
        carry, rounded = np.zeros(sums.shape[1:]), np.zeros_like(sums)
        for dot, image in enumerate(sums):
            wanted = image + carry
            rounded[dot] = np.maximum(np.round(wanted / STEP) * STEP, 0)
            carry = wanted - rounded[dot]
        return rounded.astype(np.float16)

    white, direct = still["white"].mean(2), still["direct"].mean(2)
    share = np.where(white > 0, direct / np.maximum(white, 1e-9), 0).astype(np.float32)
    uv = np.array([[(c + 0.5) / SIDE, (r + 0.5) / SIDE] for r, c in scan], np.float32)
    dots = reduced(still["T"].astype(np.float32).mean(3))
    sums = dots.astype(np.float32).sum(0)
    np.savez_compressed(out_still, T=dots, uv=uv, direct_share=share, white=sums)
    np.savez_compressed(out_planes, far=reduced(planes["far"]), near=reduced(planes["near"]))


main(*sys.argv[1:])
