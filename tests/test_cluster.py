import contextlib
import os
import signal
import sys
import threading
from dataclasses import replace

import drjit as dr
import pytest

from nil_mitsuba import checkpoint, cli, jobs, stills
from nil_mitsuba.jobs import Job

distributed = pytest.importorskip("distributed")

from nil_mitsuba import cluster  # noqa: E402
from small_stills import SCENE, TRIANGLE  # noqa: E402

JOB = Job("scene.xml")


@pytest.fixture(scope="module")
def client():
    """A cluster of two workers within this process, with Dask's own scheduler."""
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
        ) as workers,
        distributed.Client(workers) as client,
    ):
        yield client


@pytest.fixture
def hands(client, monkeypatch):
    """Hands that give out ten parts of one pass each; their contents are the passes' numbers."""
    monkeypatch.setattr(cluster, "PART_SECONDS", 1e-9)
    monkeypatch.setattr(cluster, "LOOK_SECONDS", 0.1)
    monkeypatch.setattr(jobs, "render_part", passes)
    complaints = []
    hands = cluster.Hands(client, JOB, cluster.Queue(range(10), 10), None, complaints.append)
    hands.complaints = complaints
    return hands


def passes(_job, first, stop):
    return list(range(first, stop))


def came(hands):
    return sorted(index for part in hands.parts() if part is not None for index in part)


# ------------------------------------------------------------------------- parts


@pytest.mark.parametrize("indices", [[], [7], [0, 1, 2, 3], [0, 1, 5, 6, 7, 9], range(100)])
@pytest.mark.parametrize("most", [1, 3, 1000])
def test_each_pass_is_in_one_part(indices, most):
    queue, found = cluster.Queue(indices, len(indices)), []
    while queue:
        first, stop = queue.take(most)
        assert 0 < stop - first <= most
        found += range(first, stop)
    assert found == list(indices)
    assert queue.left == 0


def test_parts_take_ten_seconds_and_become_smaller_towards_the_end():
    queue = cluster.Queue(range(100), 100)
    assert queue.size(2, None) == 1
    sizes = []
    while queue:
        first, stop = queue.take(queue.size(workers=2, seconds=1.0))
        sizes.append(stop - first)
    assert sizes[0] == cluster.PART_SECONDS
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-4:] == [1, 1, 1, 1]


def test_without_an_end_parts_have_the_same_size():
    import itertools

    queue = cluster.Queue(itertools.count(), None)
    assert [queue.take(queue.size(8, 2.0)) for _ in range(3)] == [(0, 5), (5, 10), (10, 15)]


def test_all_passes_come_once(hands):
    assert came(hands) == list(range(10))
    assert hands.complaints == []


def test_few_parts_are_on_their_way(hands, monkeypatch):
    taken = []
    monkeypatch.setattr(hands.queue, "take", lambda most: taken.append(1) or (len(taken), 0))
    monkeypatch.setattr(hands, "_done", lambda: set())
    parts = hands.parts()
    for _ in range(5):
        assert next(parts) is None
    assert len(taken) == cluster.PARTS_AHEAD * 2


def test_a_part_without_passes_comes_while_others_take_long(hands, monkeypatch):
    ready = threading.Event()
    monkeypatch.setattr(jobs, "render_part", lambda *args: ready.wait(20) and passes(*args))
    parts = hands.parts()
    assert next(parts) is None
    ready.set()
    assert sorted(index for part in parts if part is not None for index in part) == list(range(10))


def test_a_part_without_passes_changes_nothing(job):
    still = jobs.open_still(job)
    state = still.render(0)
    for sums in (state.plus(still.nothing()).sums, still.nothing().plus(state).sums):
        assert sums.passes == ((0, 1),)
        assert dr.all(sums.values == state.sums.values, axis=None)
        assert dr.any(sums.points != 0, axis=None)
        assert dr.all(sums.points == state.sums.points, axis=None)


# ---------------------------------------------------------------------- refusals


def test_a_worker_with_another_scene_is_left_out(hands, monkeypatch):
    bad = min(hands.client.nthreads())

    def render_part(job, first, stop, threads):
        if distributed.get_worker().address == bad:
            raise cluster.Refused(bad, '"scene.xml" or a file that it names differs')
        return 1.0, passes(job, first, stop)

    monkeypatch.setattr(cluster, "render_part", render_part)
    assert came(hands) == list(range(10))
    assert hands.complaints == [f'{bad} is left out: "scene.xml" or a file that it names differs.']


def test_a_scene_that_no_worker_has_ends_in_a_sentence(client):
    queue = cluster.Queue(range(4), 4)
    job = Job("/nowhere/scene.xml")
    with pytest.raises(ValueError, match="^no worker of the cluster can render this: .*nowhere"):
        list(cluster.Hands(client, job, queue, None, lambda _: None).parts())


def test_other_versions_are_refused(hands, monkeypatch):
    monkeypatch.setattr(hands, "versions", hands.versions | {"Mitsuba": "3.9.0"})
    here = cluster.versions()["Mitsuba"]
    with pytest.raises(ValueError, match=f"it has Mitsuba {here}, and here is 3.9.0"):
        came(hands)


def test_a_worker_without_nil_mitsuba_is_refused(hands, monkeypatch):
    def versions():
        raise ModuleNotFoundError("No module named 'nil_mitsuba'")

    monkeypatch.setattr(cluster, "versions", versions)
    with pytest.raises(ValueError, match="no nil_mitsuba that can be loaded .No module named"):
        came(hands)


def test_versions_that_differ_are_named():
    ours = {"nil_mitsuba": "1", "Mitsuba": "3.9.1", "Python": "3.11"}
    assert cluster.difference(ours, ours) == ""
    assert cluster.difference({"nil_mitsuba": "1", "Mitsuba": "3.9.0"}, ours) == (
        "it has Mitsuba 3.9.0, and here is 3.9.1, it has Python of no version, and here is 3.11"
    )


def test_passes_that_end_every_worker_end_in_a_sentence(hands, monkeypatch):
    class Worker:
        address = "tcp://10.0.0.7:1234"

    def render_part(*_):
        raise distributed.KilledWorker("task", Worker, 3)

    monkeypatch.setattr(jobs, "render_part", render_part)
    with pytest.raises(OSError, match=r"took the passes \d:\d+ ended, the last .*10.0.0.7:1234"):
        came(hands)


def test_passes_of_workers_that_are_gone_go_to_others(hands, monkeypatch):
    gone, handed = "tcp://127.0.0.1:1", []
    submit = hands.client.submit

    def lost(function, job, first, stop, threads, workers, pure):
        handed.append(first)
        if handed.count(3) == 1 and first == 3:  # The first time, by one that is no longer there
            return submit(function, job, first, stop, threads, workers=[gone], pure=pure)
        return submit(function, job, first, stop, threads, workers=workers, pure=pure)

    monkeypatch.setattr(hands.client, "submit", lost)
    fill = hands._fill

    def filled():
        fill()
        for future, (part, _) in hands.flying.items():
            if part[0] == 3 and handed.count(3) == 1:
                hands.flying[future] = part, frozenset([gone])

    monkeypatch.setattr(hands, "_fill", filled)
    assert came(hands) == list(range(10))
    assert handed.count(3) == 2


def test_parts_that_came_before_an_error_are_saved(job, tmp_path):
    still = jobs.open_still(job)

    def parts():
        yield still.render(0)
        raise OSError("the connection is lost.")

    saver = stills.Saver(tmp_path / "still.sums", print)
    with pytest.raises(OSError, match="the connection is lost"):
        still.accumulate(still.nothing(), parts(), saver=saver)
    assert checkpoint.load(tmp_path / "still.sums").sums.passes == ((0, 1),)


def test_a_cluster_without_workers_ends_in_a_sentence():
    with (
        distributed.LocalCluster(
            n_workers=0, processes=False, dashboard_address="127.0.0.1:0"
        ) as empty,
        distributed.Client(empty) as client,
    ):
        hands = cluster.Hands(client, JOB, cluster.Queue(range(4), 4), None, print)
        with pytest.raises(OSError, match='no workers: start some with "dask worker"'):
            came(hands)


def test_a_scheduler_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.2)
    with pytest.raises(OSError, match='no Dask scheduler answers at "tcp://127.0.0.1:9"'):
        with cluster._connected("tcp://127.0.0.1:9", 1):
            pass


def test_without_the_extra_a_sentence_says_how_to_get_it(fresh_python, tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    run = fresh_python(
        "import sys; sys.modules['distributed'] = None; from nil_mitsuba.cli import main;"
        f"sys.argv[1:] = ['render', {str(tmp_path / 'scene.xml')!r}, '--workers', '2']; main()"
    )
    assert run.returncode == 1
    assert run.stderr == (
        "nil-mitsuba: --scheduler and --workers need the package distributed: "
        "pip install 'nil-mitsuba[cluster]'\n"
    )


def test_one_cluster_is_enough(tmp_path, monkeypatch, capsys):
    (tmp_path / "scene.xml").write_text(SCENE)
    arguments = [
        "render",
        str(tmp_path / "scene.xml"),
        "--workers",
        "2",
        "--scheduler",
        "tcp://a:1",
    ]
    monkeypatch.setattr(sys, "argv", ["nil-mitsuba", *arguments])
    with pytest.raises(SystemExit) as status:
        cli.main()
    assert status.value.code == 2
    assert "--scheduler names another" in capsys.readouterr().err


# --------------------------------------------------------------------- processes


@pytest.fixture
def job(tmp_path, rgb):
    """24 passes of a picture of 32 × 18 pixels."""
    scene = SCENE.replace('name="height" value="$resolution"', 'name="height" value="18"')
    (tmp_path / "scene.xml").write_text(scene)
    (tmp_path / "triangle.obj").write_text(TRIANGLE)
    job = Job(
        str(tmp_path / "scene.xml"),
        defines={"resolution": "32"},
        spp=24 * 64,
        pass_spp=64,
        properties={"aovs": "distance,cell"},
    )
    return replace(job, scene_hash=jobs.open_still(job).settings["scene"])


@pytest.mark.verify
def test_a_killed_worker_changes_nothing_in_the_picture(job, monkeypatch):
    monkeypatch.setattr(cluster, "PART_SECONDS", 1e-9)
    still = jobs.open_still(job)
    alone, number = still.accumulate(still.nothing(), map(still.render, range(24)))
    assert number is None

    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, memory_limit=None, dashboard_address="127.0.0.1:0"
        ) as workers,
        distributed.Client(workers) as client,
    ):
        pids = set(client.run(os.getpid).values())

        def parts():
            victims, count = [min(pids)], 0
            for part in cluster.render(still, job, range(24), workers.scheduler_address):
                yield part
                count += part.sums.count
                if count >= 6 and victims:
                    os.kill(victims.pop(), signal.SIGKILL)

        together, number = still.accumulate(still.nothing(), parts())
        assert set(client.run(os.getpid).values()) != pids
    assert together.sums.passes == alone.sums.passes == ((0, 24),)
    assert dr.allclose(together.sums.values, alone.sums.values, rtol=1e-12, atol=1e-12)
    assert dr.all(together.sums.points == alone.sums.points, axis=None)


@pytest.mark.verify
def test_an_interrupted_cluster_leaves_a_checkpoint_that_one_process_goes_on_with(job):
    still = jobs.open_still(job)

    def parts():
        interrupted = False
        with contextlib.closing(cluster.render(still, job, range(24), workers=2)) as parts:
            for part in parts:
                if part.sums.count and not interrupted:
                    interrupted = True
                    os.kill(os.getpid(), signal.SIGINT)
                yield part

    state, number = still.accumulate(still.nothing(), parts())
    assert number == signal.SIGINT
    assert 0 < state.sums.count < 24
    alone, _ = still.accumulate(still.nothing(), map(still.render, range(24)))
    state, _ = still.accumulate(state, map(still.render, still.todo(state, 0, 24)))
    assert dr.allclose(state.sums.values, alone.sums.values, rtol=1e-12, atol=1e-12)
