import os
import threading

import numpy as np
import pytest

from keepout.core import cores


@pytest.mark.parametrize("count", [0, 1, 511, 512, 513, 2000])
@pytest.mark.parametrize("available", [1, 2])
def test_slices_cover_all_once(monkeypatch, count, available):
    monkeypatch.setattr(cores, "available_cores", lambda: available)
    times, threads = np.zeros(count, int), set()

    def work(part):
        assert part.stop <= count
        times[part] += 1
        threads.add(threading.current_thread())

    cores.share_among_cores(work, count)
    assert np.all(times == 1)
    assert (threading.current_thread() in threads) == (count > 0 and (available == 1 or count <= 512))


def test_an_error_comes_out_and_the_threads_go_on(monkeypatch):
    monkeypatch.setattr(cores, "available_cores", lambda: 2)

    def fails(part):
        if part.start:
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        cores.share_among_cores(fails, 2000)
    done = np.zeros(2000, bool)
    cores.share_among_cores(lambda part: done.__setitem__(part, True), 2000)
    assert done.all()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning", "ignore:.*fork:RuntimeWarning")
def test_a_fork_has_threads_of_its_own(monkeypatch):
    monkeypatch.setattr(cores, "available_cores", lambda: 2)
    cores.share_among_cores(lambda part: None, 2000)
    child = os.fork()
    if not child:
        cores.share_among_cores(lambda part: None, 2000)
        os._exit(7)
    for _ in range(200):
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            break
        threading.Event().wait(0.05)
    else:
        os.kill(child, 9)
        os.waitpid(child, 0)
    assert found
    assert os.waitstatus_to_exitcode(status) == 7
