"""Splits into training and test rows. Repeated configurations are always on the same side.

kfold         five folds: every pose is predicted once, by a model of the four other folds
curve         30 % held out; of the remaining poses a random subset of every size, once per seed
extrapolate   trained on the lower 70 % of the first joint's values, tested on the upper 30 %
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

import diffeo_calib as dc

PROTOCOLS = ("kfold", "curve", "extrapolate")
FOLDS, FOLD_SEED = 5, 0
SHARE = 0.7
SIZES = (30, 60, 120, 150, 250)
ALL = "all"


@dataclass(frozen=True)
class Split:
    """Rows to calibrate with and rows to test on.

    `size` is the requested number of poses ("all" without a limit), `index` the fold or the seed.
    """

    protocol: str
    size: str
    index: int
    train: dc.Measurements
    test: dc.Measurements


def splits(data: dc.Measurements, protocols: Sequence[str], sizes: Sequence[int | None], seeds: int) -> Iterator[Split]:
    """Yield the splits of one data set.

    Args:
        data: the whole data set.
        protocols: names of protocols.
        sizes: training poses of `curve`; None is the whole training part, larger sizes are omitted.
        seeds: number of seeds 0, 1, ... of `curve`.
    """
    if "kfold" in protocols:
        for fold, (train, test) in enumerate(data.folds(FOLDS, FOLD_SEED)):
            yield Split("kfold", ALL, fold, train, test)
    if "curve" in protocols:
        for seed in range(seeds):
            yield from curve(data, sizes, seed)
    if "extrapolate" in protocols:
        yield Split("extrapolate", ALL, 0, *beyond(data))


def curve(data: dc.Measurements, sizes: Sequence[int | None], seed: int) -> Iterator[Split]:
    """Yield nested training sets, small ones first, all with the same test rows."""
    train, test = data.split(SHARE, seed)
    order = np.random.default_rng(seed).permutation(len(train))
    for size in sorted(size for size in sizes if size is not None and size < len(train)):
        yield Split("curve", str(size), seed, train[order[:size]], test)
    if None in sizes:
        yield Split("curve", ALL, seed, train, test)


def beyond(data: dc.Measurements) -> tuple[dc.Measurements, dc.Measurements]:
    """Split at a quantile of the first joint's values; repeats follow the first one of their group."""
    labels = data.groups().numpy()
    _, first = np.unique(labels, return_index=True)
    place = data.q[:, 0].numpy()[first][labels]
    inside = place <= np.quantile(place, SHARE)
    return data[inside], data[~inside]
