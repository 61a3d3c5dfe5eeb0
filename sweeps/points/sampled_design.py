"""Points of a sweep: axes of a grid crossed with a sampled design. Each point is a function of its number.

Nothing here depends on chunks, devices or JAX: NumPy computes point k from the seed and k.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import hashlib
import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt64

from calibration.data import Columns, Names

#: Name of the sampled dimension in a store.
SAMPLE = "sample"
#: Axis with the number of a table's run.
ROW = "run"


#: Number of points in one call of a distribution. JAX compiles a program for each number, and sums over coordinates
#: may depend on it.
BLOCK_POINTS = 4096
#: Number of points that a thread computes at once is a multiple of this.
THREAD_POINTS = 16 * BLOCK_POINTS


@dataclasses.dataclass(frozen=True)
class Samples:
    """A sampled design over some names.

    Attributes:
        design: one of `DESIGNS`.
        number: number of points.
        seed: random seed.
        marginals: quantile function of each name, from (0, 1) to its unit.
        names: names of `marginals`.
        joint: posterior of further names that are sampled together. It uses the last dimensions of the design.
    """

    design: str
    number: int
    seed: int
    marginals: dict[str, Callable[[np.ndarray], np.ndarray]]
    joint: Any = None

    @property
    def names(self) -> Names:
        """Sampled names, in order."""
        return (*self.marginals, *(self.joint.names if self.joint is not None else ()))

    def values(self, first: int, count: int) -> Float[np.ndarray, "names points"]:
        """Values of `count` points from number `first` on, one row for each name. Many points are computed on all
        processors.
        """
        if count <= THREAD_POINTS:
            return self._values(first, count)
        starts = range(first - first % THREAD_POINTS, first + count, THREAD_POINTS)
        ranges = [(max(start, first), min(start + THREAD_POINTS, first + count)) for start in starts]
        with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as threads:
            return np.concatenate(
                [*threads.map(lambda limits: self._values(limits[0], limits[1] - limits[0]), ranges)], axis=1
            )

    def _values(self, first: int, count: int) -> Float[np.ndarray, "names points"]:
        from scipy.special import ndtri

        joint_count = 0 if self.joint is None else len(self.joint)
        block_start = first - first % BLOCK_POINTS
        padded_count = first + count + -(first + count) % BLOCK_POINTS - block_start
        unit = DESIGNS[self.design](
            self.seed, self.number, len(self.marginals) + joint_count, block_start, padded_count
        )
        rows = [quantile(u) for quantile, u in zip(self.marginals.values(), unit, strict=False)]
        if self.joint is not None:
            rows.extend(in_blocks(self.joint.values, ndtri(unit[len(self.marginals) :]).T).T)
        return np.array(rows)[:, first - block_start : first - block_start + count]


@dataclasses.dataclass(frozen=True)
class DrawnSamples:
    """Sampled points that are already available.

    Attributes:
        names: sampled names.
        table: their values, one row for each name.
    """

    names: Names
    table: Float[np.ndarray, "names points"]

    @property
    def number(self) -> int:
        """Number of points."""
        return self.table.shape[1]

    def values(self, first: int, count: int) -> Float[np.ndarray, "names points"]:
        """Values of `count` points from number `first` on, one row for each name."""
        return self.table[:, first : first + count]


def in_blocks(
    values: Callable[[Any], Any],
    normal_scores: Float[np.ndarray, "points coordinates"],
) -> Float[np.ndarray, "points names"]:
    """Values of a JAX function at many points, computed on the CPU regardless of the sweep's device."""
    import jax

    count = len(normal_scores)
    padded = np.zeros((count + -count % BLOCK_POINTS, *normal_scores.shape[1:]))
    padded[:count] = normal_scores
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        blocks = [np.asarray(values(padded[k : k + BLOCK_POINTS])) for k in range(0, len(padded), BLOCK_POINTS)]
    return np.concatenate(blocks)[:count]


@dataclasses.dataclass(frozen=True)
class Design:
    """Every combination of the axes' values, combined with every sampled point.

    Attributes:
        axes: values of each name, in order. The last axis varies fastest, and samples even faster.
        samples: None for a plain grid.
    """

    axes: Columns
    samples: Samples | DrawnSamples | None = None

    @property
    def names(self) -> Names:
        """Varied names: axes, then samples."""
        return (*self.axes, *(self.samples.names if self.samples is not None else ()))

    @property
    def dimensions(self) -> Names:
        """Names of the dimensions of every output."""
        return (*self.axes, *((SAMPLE,) if self.samples is not None else ()))

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the dimensions."""
        return (*(len(v) for v in self.axes.values()), *((self.samples.number,) if self.samples is not None else ()))

    @property
    def points(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    def values_in_slices(self, box: tuple[slice, ...]) -> Float[np.ndarray, "points names"]:
        """Values of the points in a box, one row for each point, in the order of `names`. Columns are contiguous in
        memory.
        """
        sizes = tuple(b.stop - b.start for b in box)
        values = np.empty((len(self.names), *sizes))
        for k, axis in enumerate(self.axes.values()):
            broadcast = (slice(None),) + (None,) * (len(sizes) - k - 1)
            values[k] = axis[box[k]][broadcast]
        if self.samples is not None:
            samples = self.samples.values(box[-1].start, sizes[-1])
            for k, row in enumerate(samples, len(self.axes)):
                values[k] = row
        return values.reshape(len(self.names), -1).T

    def at(self, numbers: Int[np.ndarray, " points"]) -> Float[np.ndarray, "points names"]:
        """Values of a few points by their numbers. The last dimension varies fastest."""
        indices = np.array(np.unravel_index(np.asarray(numbers), self.shape)).T
        return np.concatenate(
            [self.values_in_slices(tuple(slice(i, i + 1) for i in map(int, index))) for index in indices]
        )


@dataclasses.dataclass(frozen=True)
class Blocks:
    """Chunks of a sweep: equal boxes of consecutive points. Boxes at the end of the split axis may be smaller.

    Attributes:
        shape: shape of all points.
        size: size of one box: 1 along axes before the split one, the whole length along axes after it.
    """

    shape: tuple[int, ...]
    size: tuple[int, ...]

    @staticmethod
    def of(shape: tuple[int, ...], max_points: int) -> Blocks:
        """Boxes with at most `max_points` points and nearly equal sizes."""
        size = [1] * len(shape)
        inner = 1
        for k in reversed(range(len(shape))):
            if inner * shape[k] > max_points:
                parts = math.ceil(shape[k] / max(max_points // inner, 1))
                size[k] = math.ceil(shape[k] / parts)
                break
            size[k] = shape[k]
            inner *= shape[k]
        return Blocks(shape, tuple(size))

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of boxes along each axis."""
        return tuple(math.ceil(n / s) for n, s in zip(self.shape, self.size, strict=True))

    @property
    def points(self) -> int:
        """Number of points in a full box."""
        return math.prod(self.size)

    def __len__(self) -> int:
        return math.prod(self.counts)

    def place(self, number: int) -> tuple[int, ...]:
        """Position of a chunk along each axis."""
        return tuple(map(int, np.unravel_index(number, self.counts)))

    def box(self, number: int) -> tuple[slice, ...]:
        """Range of a chunk along each axis."""
        per_axis = zip(self.place(number), self.size, self.shape, strict=True)
        return tuple(slice(k * s, min((k + 1) * s, n)) for k, s, n in per_axis)

    def count(self, number: int) -> int:
        """Number of points in a chunk."""
        return math.prod(b.stop - b.start for b in self.box(number))


# --- designs: functions of (seed, number of points, dimensions, first, count) with values in (0, 1), (dimensions,
# count) ----

Unit = Float[np.ndarray, "dimensions points"]


def _random_key(seed: int, dimension: int, use: str) -> int:
    """128-bit key that is unique to a seed, a dimension and a use."""
    return int.from_bytes(hashlib.blake2b(f"{seed} {dimension} {use}".encode(), digest_size=16).digest(), "little")


def philox_uniform(key: int, first: int, count: int) -> Float[np.ndarray, " points"]:
    """Numbers in (0, 1) from a counter-based generator (Philox 4 x 64, Salmon et al. 2011), from `first` on."""
    generator = np.random.Philox(key=key)
    generator.advance(first // 4)  # each counter value gives four words
    words = generator.random_raw(first % 4 + count)[first % 4 :]
    return ((words >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53


def random_points(seed: int, number: int, dimensions: int, first: int, count: int) -> Unit:
    """Independent points."""
    return np.array([philox_uniform(_random_key(seed, d, "random"), first, count) for d in range(dimensions)])


def latin_hypercube(seed: int, number: int, dimensions: int, first: int, count: int) -> Unit:
    """Latin hypercube: one point in each of `number` equal slices of each dimension (McKay et al. 1979).

    The slice of point k is a keyed permutation of k, so points are independent of one another.
    """
    unit = np.empty((dimensions, count))
    for d in range(dimensions):
        jitter = philox_uniform(_random_key(seed, d, "jitter"), first, count)
        points = np.minimum(np.arange(first, first + count, dtype=np.uint64), np.uint64(number - 1))
        slices = keyed_permutation(_random_key(seed, d, "slices"), number, points)
        unit[d] = (slices + jitter) / number
    return np.clip(unit, 2.0**-54, 1 - 2.0**-53)


#: Rounds of the Feistel network. Luby and Rackoff (1988) need four. The others make up for weak round functions.
ROUNDS = 8
#: Points that are permuted together, so few that they stay in the processor's cache.
CACHE_POINTS = 65_536


def keyed_permutation(key: int, number: int, points: UInt64[np.ndarray, " points"]) -> UInt64[np.ndarray, " points"]:
    """Keyed pseudo-random permutation of 0 .. number - 1, evaluated at some points.

    Feistel network on a x b >= number with alternate additions modulo a and b (Black and Rogaway 2002, similar to
    FE2). Results outside the range are permuted again until they are inside: fewer than 2 / sqrt(number) of the
    points.
    """
    if number == 1:
        return np.zeros_like(points)
    a = math.isqrt(number - 1) + 1
    b = -(-number // a)
    keys = np.random.Philox(key=key).random_raw(ROUNDS)
    permuted = np.array(points)
    for first in range(0, len(permuted), CACHE_POINTS):
        block = permuted[first : first + CACHE_POINTS]
        unplaced = np.arange(len(block))
        scratch = np.empty((2, len(block)), np.uint64)
        while len(unplaced):
            high, low = np.divmod(block[unplaced], np.uint64(b))
            x, y = scratch[:, : len(unplaced)]
            for k in range(0, ROUNDS, 2):
                _add_modulo(high, _mix_words(low, keys[k], x, y), np.uint64(a), y)
                _add_modulo(low, _mix_words(high, keys[k + 1], x, y), np.uint64(b), y)
            high *= np.uint64(b)
            high += low
            block[unplaced] = high
            unplaced = unplaced[high >= number]
    return permuted


Words = UInt64[np.ndarray, " n"]


def _add_modulo(x: Words, word: Words, modulus: np.uint64, scratch: Words) -> None:
    """x = x + r modulo `modulus` (below 2^32). r scales the upper half of a word to 0 .. most - 1."""
    word >>= np.uint64(32)
    word *= modulus
    word >>= np.uint64(32)
    x += word
    np.subtract(x, modulus, out=scratch)
    np.minimum(x, scratch, out=x)  # a negative difference wraps to a larger number


def _mix_words(words: Words, key: np.uint64, x: Words, scratch: Words) -> Words:
    """Finaliser of splitmix64 (Steele et al. 2014) for words and a key, stored in x.

    All operations are in place, because threads that allocate memory delay each other.
    """
    with np.errstate(over="ignore"):
        np.multiply(words, np.uint64(0x9E3779B97F4A7C15), out=x)
        x += key
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            np.right_shift(x, np.uint64(shift), out=scratch)
            x ^= scratch
            x *= np.uint64(factor)
        np.right_shift(x, np.uint64(31), out=scratch)
        x ^= scratch
    return x


#: Bits of a Sobol number. A double has room for them and for the half that keeps it above 0.
BITS = 52
_LOW_BITS = 12  # low bits of a point's number, tabulated


def sobol(seed: int, number: int, dimensions: int, first: int, count: int) -> Unit:
    """Scrambled Sobol sequence, equal to that of `scipy.stats.qmc.Sobol` (Joe and Kuo 2008), computed point by point.

    It can start at any point: point k is the sum modulo 2 of the direction numbers in the Gray code of k. It is
    balanced if the number of points is a power of 2.
    """
    directions, shift = _directions(seed, dimensions)
    table = np.zeros((dimensions, 1), np.uint64)  # for k = 0 .. 2^LOW - 1, in the order of Gray codes
    for bit in range(_LOW_BITS):
        table = np.concatenate([table, table[:, ::-1] ^ directions[:, bit : bit + 1]], axis=1)
    unit = np.empty((dimensions, count))
    size = 1 << _LOW_BITS
    for block in range(first >> _LOW_BITS, ((first + count - 1) >> _LOW_BITS) + 1):
        begin, end = max(first, block * size), min(first + count, (block + 1) * size)
        # gray(block * 2^LOW + i) = gray(block * 2^LOW) ^ gray(i)
        gray = block * size ^ (block * size >> 1)
        bits = [bit for bit in range(gray.bit_length()) if gray >> bit & 1]
        high = shift ^ np.bitwise_xor.reduce(directions[:, bits], axis=1)
        words = table[:, begin - block * size : end - block * size] ^ high[:, None]
        unit[:, begin - first : end - first] = words.astype(float)
    return (unit + 0.5) * 2.0**-BITS


@functools.lru_cache(maxsize=8)
def _directions(seed: int, dimensions: int) -> tuple[np.ndarray, np.ndarray]:
    """Scrambled direction numbers, shape (dimensions, BITS), and the digital shift, shape (dimensions,)."""
    from scipy.stats import qmc

    engine = qmc.Sobol(dimensions, scramble=True, bits=BITS, rng=np.random.default_rng(seed))
    # Private in SciPy. A test compares with its public points.
    return np.asarray(engine._sv, np.uint64), np.asarray(engine._shift, np.uint64)


DESIGNS: dict[str, Callable[[int, int, int, int, int], Unit]] = {
    "latin_hypercube": latin_hypercube,
    "sobol": sobol,
    "random": random_points,
}
