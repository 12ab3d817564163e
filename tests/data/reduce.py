"""Reduce a rendered plane-to-ray scene to a repository-sized copy, and to every second column of it:
`reduce.py IN.npz FRAMES.npz OUT.npz HALF.npz`.

T[v, t, s] is rounded to steps well below the renderer's own noise (9 % of an entry off the plane). The rounding error
is carried to the next projector row of the same pixel, so that sums over rows (images, totals, shares) keep their
accuracy while single entries lose theirs. Fails if the copy no longer predicts the reference frames.
"""

import io
import sys
import zipfile

import numpy as np

DIRECT_ROWS = 2  # |u| up to here keeps 8 bits of mantissa: the direct light and what leaks beside it
COARSE_STEP, FINE_STEP = 2.0**-14, 2.0**-15
FINE_ROWS = range(40, 70)  # the dimmest reference frame (1200 us, 450 us) looks here


def round_rows(transport):
    rows = transport.shape[0]
    u = np.abs(np.arange(rows)[:, None] - np.arange(transport.shape[1])[None, :])[:, :, None]
    reduced = np.zeros_like(transport)
    carry = np.zeros(transport.shape[1:])
    for v in range(rows):
        relative_step = np.ldexp(1.0, np.frexp(np.maximum(transport[v], 1e-9))[1] - 1 - 8)
        fine = np.isin(u[v], FINE_ROWS)
        step = np.where(u[v] <= DIRECT_ROWS, relative_step, np.where(fine, FINE_STEP, COARSE_STEP))
        wanted = np.where(transport[v] > 0, transport[v] + carry, 0)
        reduced[v] = np.maximum(np.round(wanted / step) * step, 0)
        carry += transport[v].astype(float) - reduced[v]
    return reduced


def predict(transport, delay_us, exposure_us, row_time_us):
    rows = transport.shape[0]
    centre_us = (np.arange(rows)[:, None] - np.arange(transport.shape[1])[None, :]) * row_time_us
    start = np.maximum(centre_us - row_time_us / 2, delay_us - exposure_us / 2)
    end = np.minimum(centre_us + row_time_us / 2, delay_us + exposure_us / 2)
    return np.einsum("vt,vts->ts", np.maximum(end - start, 0) / row_time_us, transport.astype(float))


def write(target, transport):
    # np.savez_compressed has no level; 9 saves 5 %. The fixed date keeps the file the same at every run.
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(transport))
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        entry = zipfile.ZipInfo("T.npy", (1980, 1, 1, 0, 0, 0))
        entry.compress_type = zipfile.ZIP_DEFLATED
        archive.writestr(entry, buffer.getvalue(), compresslevel=9)


def main(source, frames_file, target, half):
    transport = np.load(source)["T"]
    reduced = round_rows(transport)

    reference = np.load(frames_file)
    for frame, delay_us, exposure_us in zip(reference["frames"], reference["delay_us"], reference["exposure_us"]):
        error = np.abs(predict(reduced, delay_us, exposure_us, float(reference["row_time_us"])) - frame).max()
        print(f"t_d {delay_us:6.0f} us, t_e {exposure_us:5.0f} us: {error / frame.max():.2e} of the largest value")
        assert error <= 1e-3 * frame.max()
    print(f"total: {reduced.sum(dtype=float) / transport.sum(dtype=float) - 1:+.1e}")

    write(target, reduced)
    write(half, reduced[:, :, ::2])


main(*sys.argv[1:])
