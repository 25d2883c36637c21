"""NumPy and SciPy are limited to one thread where torch needs the cores, and get their threads back afterwards."""

from __future__ import annotations

import pytest
import scipy.linalg  # noqa: F401  # its OpenBLAS is known only once it is loaded
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from diffeo_calib.common.threads import belongs_to_torch, torch_alone


def counts() -> list[int]:
    """Number of threads of every OpenBLAS of NumPy and SciPy."""
    return [
        one["num_threads"]
        for one in threadpool_info()
        if one["internal_api"] == "openblas" and "/torch" not in one["filepath"]
    ]


def test_one_thread_inside_and_as_many_as_before_outside() -> None:
    if not counts():
        pytest.skip("NumPy and SciPy have no OpenBLAS here")
    kept = torch.get_num_threads()
    with threadpool_limits(2, user_api="blas"):
        before = counts()
        with torch_alone():
            assert set(counts()) == {1}
            assert torch.get_num_threads() == kept
        assert counts() == before
    assert 2 in before


def test_libraries_of_torch_are_recognised_by_their_folder() -> None:
    at = "/home/torch/torch-env/lib/python3.11/site-packages"
    assert belongs_to_torch({"filepath": f"{at}/torch/lib/libopenblas.so"})
    assert belongs_to_torch({"filepath": f"{at}/torch.libs/libopenblas.so"})
    assert not belongs_to_torch({"filepath": f"{at}/numpy.libs/libopenblas.so"})
