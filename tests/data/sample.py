"""Take the profiles of some pixels of rendered plane-to-ray scenes: `sample.py OUT.npz SCENE.npz...`.

OUT holds for each scene NAME, `p2r_NAME.npz`, an array NAME: T[v, t, s] of every 8th camera row and column from 4 on,
float32, rounded to 8 bits of mantissa or steps of 2^-17.
"""

import io
import re
import sys
import zipfile

import numpy as np


def main(target, *sources):
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for source in sources:
            name = re.search(r"p2r_(\w+)\.npz$", source).group(1)
            profiles = np.load(source)["T"][:, 4::8, 4::8]
            mantissa, exponent = np.frexp(profiles)
            step = np.ldexp(1.0, np.maximum(exponent - 8, -17))
            rounded = (np.round(profiles / step) * step).astype(np.float32)
            buffer = io.BytesIO()
            np.save(buffer, rounded)
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, buffer.getvalue(), compresslevel=9)


main(*sys.argv[1:])
