#!/usr/bin/env python3
"""Times what others use for the demultiplexer's problem, for `cargo xtask bench demux --peers`.

    python3 -m venv VENV && VENV/bin/pip install -r tests/python/peers-requirements.txt
    VENV/bin/python tests/python/peers.py FOLDER

FOLDER holds one stack and its problem, the same for every pixel: minimise over T >= 0

    ||A T - I||^2 + alpha ||D T||^2 + beta sum(T)

with A in weights.npy [settings, rows], D in differences.npy [differences, rows], alpha and beta in prior.json, the I of
all pixels in stack.npy [settings, t, s], and the least value of each pixel, found by raysweep's f64 reference, in
best.npy [t, s]; pixels that it did not solve hold NaN.

Each peer solves a seeded sample of the pixels, spread over one process for each CPU; its time is scaled to all pixels.
Imports, loading, and what a peer computes once for all pixels happen before the clock starts. Prints one JSON line for
each peer.
"""

import os

# One process for each CPU, so one thread for each process; NumPy reads this when it is imported.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import functools
import itertools
import json
import multiprocessing
import pathlib
import sys
import time
import warnings

import cvxpy
import numpy as np
import scipy.optimize

SEED = 1
CPUS = len(os.sched_getaffinity(0))
REPETITIONS = 3
SHARES_PER_CPU = 4
"""So that no CPU waits long for another at the end."""
EQUAL_GAP = 1e-6
"""What raysweep's tests demand of every pixel: the relative distance from the least objective."""


class Problem:
    """The objective that all pixels share, and the pixels that may be timed."""

    def __init__(self, folder):
        self.weights = np.load(folder / "weights.npy")
        self.differences = np.load(folder / "differences.npy")
        prior = json.loads((folder / "prior.json").read_text())
        self.alpha, self.beta = prior["alpha"], prior["beta"]
        self.rows = self.weights.shape[1]
        self.h = self.weights.T @ self.weights + self.alpha * self.differences.T @ self.differences
        stack = np.load(folder / "stack.npy").astype(np.float64)
        best = np.load(folder / "best.npy")
        self.pixels = best.size
        solved = np.isfinite(best)
        order = np.random.default_rng(SEED).permutation(np.count_nonzero(solved))
        self.samples = stack[:, solved].T[order]
        self.best = best[solved][order]

    def linear(self, samples):
        """`A'I - beta/2` of each pixel, [pixels, rows]."""
        return samples @ self.weights - self.beta / 2

    def gaps(self, transport):
        """Relative distance of the first pixels' objective from the least, after clipping to T >= 0."""
        count = len(transport)
        t = np.maximum(transport, 0.0)
        misfit = t @ self.weights.T - self.samples[:count]
        rough = t @ self.differences.T
        value = (misfit**2).sum(1) + self.alpha * (rough**2).sum(1) + self.beta * t.sum(1)
        return value / self.best[:count] - 1


def cvxpy_problem(problem, intensities):
    t = cvxpy.Variable(problem.rows)
    smooth = problem.alpha * cvxpy.sum_squares(problem.differences @ t)
    misfit = cvxpy.sum_squares(problem.weights @ t - intensities)
    return t, cvxpy.Problem(cvxpy.Minimize(misfit + smooth + problem.beta * cvxpy.sum(t)), [t >= 0])


def cvxpy_fresh(problem):
    """What the paper did: a new problem for each pixel, the solver left to CVXPY."""

    def solve(intensities):
        t, fresh = cvxpy_problem(problem, intensities)
        fresh.solve()
        return t.value

    return pixel_by_pixel(solve)


def cvxpy_parametrised(problem, solver):
    """Disciplined parametrised programming: canonicalised once, then only the parameter changes."""
    intensities = cvxpy.Parameter(len(problem.weights))
    t, parametrised = cvxpy_problem(problem, intensities)

    def solve(values):
        intensities.value = values
        parametrised.solve(solver=solver)
        return t.value

    return pixel_by_pixel(solve)


def scipy_nnls(problem):
    """Non-negative least squares on `||L'T - L^-1 c||^2` with `L L' = H`: the same objective, as a square system."""
    lower = np.linalg.cholesky(problem.h)
    upper = np.ascontiguousarray(lower.T)

    def solve(intensities):
        target = scipy.linalg.solve_triangular(lower, problem.linear(intensities), lower=True)
        return scipy.optimize.nnls(upper, target, maxiter=30 * problem.rows)[0]

    return pixel_by_pixel(solve)


def pixel_by_pixel(solve):
    return lambda samples: np.array([solve(intensities) for intensities in samples])


class Admm:
    """ADMM of many pixels at once, one NumPy product an iteration.

    Plain: double precision on H as it is. Tuned: single precision, rows scaled to a unit diagonal of H.
    """

    BLOCK = 512
    RELAXATION = 1.6
    PIXELS = BLOCK * CPUS * SHARES_PER_CPU
    # The likely ones first, because each next one is given up where the best so far was done.
    PENALTIES = (0.1, 0.03, 0.3, 0.01, 1.0)
    CHECK_EVERY, MOST_ITERATIONS = 50, 3000

    def __init__(self, problem, tuned, penalty):
        self.problem, self.dtype = problem, np.float32 if tuned else np.float64
        diagonal = np.diag(problem.h)
        self.scale = 1 / np.sqrt(diagonal if tuned else np.full_like(diagonal, diagonal.mean()))
        scaled = problem.h * np.outer(self.scale, self.scale)
        self.inverse = np.linalg.inv(scaled + penalty * np.eye(problem.rows))
        self.step = (penalty * self.inverse).astype(self.dtype)

    def estimates(self, samples):
        """The scaled estimate after each iteration, for ever."""
        constant = (self.problem.linear(samples) * self.scale @ self.inverse).astype(self.dtype)
        z = np.zeros_like(constant)
        u = np.zeros_like(constant)
        while True:
            x = constant + (z - u) @ self.step
            u += self.RELAXATION * x + (1 - self.RELAXATION) * z
            np.maximum(u, 0, out=z)
            u -= z
            yield z

    def solve(self, samples, iterations):
        """Block by block, so that all of a block stays in the cache."""
        blocks = np.array_split(samples, -(-len(samples) // self.BLOCK))
        last = [next(itertools.islice(self.estimates(block), iterations - 1, None)) for block in blocks]
        return np.concatenate(last) * self.scale

    @classmethod
    def calibrated(cls, problem, tuned):
        """The penalty that needs the fewest iterations until every timed pixel is as exact as raysweep's, and how
        many these are: the most where none suffices."""
        fewest, best = cls.MOST_ITERATIONS, cls.PENALTIES[0]
        for penalty in cls.PENALTIES:
            admm = cls(problem, tuned, penalty)
            samples = problem.samples[: cls.PIXELS]
            for iteration, z in enumerate(itertools.islice(admm.estimates(samples), fewest - 1), start=1):
                if iteration % cls.CHECK_EVERY == 0 and problem.gaps(z * admm.scale).max() <= EQUAL_GAP:
                    fewest, best = iteration, penalty
                    break
        return best, fewest


def admm(problem, tuned, penalty, iterations):
    method = Admm(problem, tuned, penalty)
    return lambda samples: method.solve(samples, iterations)


def start(folder, make, ready):
    """In each process: prepares the method and runs it once before the clock starts."""
    global solve
    warnings.simplefilter("ignore")
    problem = Problem(folder)
    solve = make(problem)
    solve(problem.samples[:2])
    ready.wait()


def solve_share(samples):
    return solve(samples)


def time_method(folder, problem, method, make, count):
    """Prints seconds for all pixels, the least and the median of the repetitions, and the gaps of the `count` pixels
    that were solved."""
    samples = problem.samples[:count]
    shares = np.array_split(samples, CPUS * SHARES_PER_CPU)
    ready = multiprocessing.Barrier(CPUS + 1)
    with multiprocessing.Pool(CPUS, start, (folder, make, ready)) as pool:
        ready.wait()
        seconds = []
        for _ in range(REPETITIONS):
            began = time.perf_counter()
            transport = np.concatenate(pool.map(solve_share, shares, chunksize=1))
            seconds.append(time.perf_counter() - began)
    gaps = problem.gaps(transport)
    scale = problem.pixels / len(samples)
    figures = {
        "method": method,
        "seconds": min(seconds) * scale,
        "seconds_median": float(np.median(seconds)) * scale,
        "pixels_timed": len(samples),
        "gap_median": float(np.median(gaps)),
        "gap_largest": float(gaps.max()),
    }
    print(json.dumps(figures), flush=True)


def default_solver(problem):
    _, fresh = cvxpy_problem(problem, problem.samples[0])
    fresh.solve()
    return fresh.solver_stats.solver_name


def main(folder):
    warnings.simplefilter("ignore")
    problem = Problem(folder)
    measure = functools.partial(time_method, folder, problem)
    version = f"CVXPY {cvxpy.__version__}"
    measure(f"{version}, new problem per pixel, {default_solver(problem)}", cvxpy_fresh, 256)
    for solver in ("OSQP", "CLARABEL"):
        make = functools.partial(cvxpy_parametrised, solver=solver)
        measure(f"{version}, parametrised (DPP), {solver}", make, 512)
    measure(f"scipy {scipy.__version__} nnls", scipy_nnls, 2048)
    for tuned in (False, True):
        penalty, equal = Admm.calibrated(problem, tuned)
        name = f"NumPy ADMM, {'tuned' if tuned else 'plain'}"
        for iterations in sorted({200, equal}):
            accuracy = ", equal accuracy" if iterations == equal else ""
            make = functools.partial(admm, tuned=tuned, penalty=penalty, iterations=iterations)
            measure(f"{name}, {iterations} iterations{accuracy}", make, Admm.PIXELS)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(pathlib.Path(sys.argv[1]))
