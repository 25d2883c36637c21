"""Small work runs on one thread, large work on those that the user allows, and every setting is restored afterwards."""

import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import scipy.linalg  # noqa: F401  # its OpenBLAS is known only once it is loaded
import torch
from math_bank import torch_threads
from section_5 import section_5
from threadpoolctl import threadpool_info, threadpool_limits

import diffeo_calib as dc
from diffeo_calib.common.threads import LARGE_MATRIX, allowed_threads, in_parallel, large_work, small_work, torch_alone


def counts() -> list[int]:
    """Number of threads of every OpenBLAS of NumPy and SciPy."""
    pools = [one for one in threadpool_info() if "/torch" not in one["filepath"]]
    return [one["num_threads"] for one in pools if one["internal_api"] == "openblas"]


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


def test_small_and_large_work_and_the_setting_afterwards() -> None:
    with torch_threads(3):
        with small_work():
            assert torch.get_num_threads() == 1
            assert allowed_threads() == 3
            with small_work(), large_work(LARGE_MATRIX):
                assert torch.get_num_threads() == 3
            with large_work(LARGE_MATRIX - 1):
                assert torch.get_num_threads() == 1
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 3
    with torch_threads(3):
        with pytest.raises(KeyboardInterrupt), small_work(), large_work(LARGE_MATRIX):
            raise KeyboardInterrupt
        assert torch.get_num_threads() == 3
        with pytest.raises(ZeroDivisionError):
            list(in_parallel(lambda part: 1 // part, [1, 0, 1]))
        assert torch.get_num_threads() == 3


@pytest.mark.parametrize("count", [1, 3])
def test_parts_run_on_one_thread_each_and_come_back_in_order(count: int) -> None:
    with torch_threads(count):
        found = list(in_parallel(lambda part: (part, torch.get_num_threads(), threading.get_ident()), range(40)))
    assert [part for part, _, _ in found] == list(range(40))
    assert {inside for _, inside, _ in found} == {1}
    assert len({thread for _, _, thread in found}) <= count


def _squares(queue: multiprocessing.Queue) -> None:
    queue.put(list(in_parallel(lambda part: part * part, range(5))))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system does not fork")
def test_a_forked_process_has_workers_of_its_own() -> None:
    with torch_threads(2):
        list(in_parallel(str, range(4)))
        context = multiprocessing.get_context("fork")
        queue = context.Queue()
        process = context.Process(target=_squares, args=(queue,))
        process.start()
        try:
            assert queue.get(timeout=60) == [0, 1, 4, 9, 16]
        finally:
            process.kill()


def test_fits_run_on_one_thread_whatever_the_setting_and_agree_in_the_thread_pool_of_another_program() -> None:
    problem, seen = section_5(0.01), set[int]()
    with torch_threads(2):
        alone = dc.fit(problem, integrator=dc.RK4(2), progress=lambda *_: seen.add(torch.get_num_threads())).energy
        with ThreadPoolExecutor(3) as pool:
            energies = list(pool.map(lambda _: dc.fit(problem, integrator=dc.RK4(2)).energy, range(3)))
        assert torch.get_num_threads() == 2
    assert energies == [alone] * 3
    assert seen == {1}
