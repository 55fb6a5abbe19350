"""What counts queries and compares checkouts."""

import subprocess
import sys
from pathlib import Path

import pytest

from conftest import ENVIRONMENT

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def workloads(rgb):
    """The module of the workloads, which is imported when a variant is set."""
    from benchmarks import workloads

    return workloads


def test_a_straight_ray_in_plain_space_takes_one_query(workloads):
    counts = workloads.Render(workloads.bent_box(16, twist=0.0), 4).counts()
    assert counts["queries"] == counts["rays"]
    assert counts["rays"]["seen"] == 1
    # Each depth has its rays in fewer packets than all would fill, but not in fewer than they fill
    for kind, rays in counts["rays"].items():
        assert rays <= counts["packets"][kind] <= 5


def test_a_packet_of_which_one_lane_asks_is_counted_as_a_whole(rgb):
    import drjit as dr

    from benchmarks.counts import KINDS, Counts

    counts = Counts()
    lane = dr.arange(rgb.UInt32, 8 * counts.width)
    # In the first half of the packets every lane, in the others the first one of them
    active = (lane < 4 * counts.width) | (lane % counts.width == 0)
    counts.add_call(dr.full(rgb.UInt32, KINDS.index("soft"), len(lane)), active)
    each = counts.each(len(lane))
    assert each["packets"] == {"seen": 0, "soft": 1, "shadow": 0}
    assert each["queries"]["soft"] == pytest.approx((4 * counts.width + 4) / len(lane))


def test_bending_takes_more_queries_than_rays(workloads):
    counts = workloads.Render(workloads.bent_box(16), 4).counts()
    for kind in ("seen", "soft", "shadow"):
        assert counts["queries"][kind] > counts["rays"][kind]


def run(*words):
    return subprocess.run(
        [sys.executable, "-m", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        env=ENVIRONMENT,
    )


def test_another_checkout_is_measured_with_its_own_package(tmp_path):
    """It fails on purpose, where and only where it is the one that is asked."""
    (tmp_path / "nil_mitsuba").symlink_to(ROOT / "nil_mitsuba")
    done = run("benchmarks.speed", "--quick", "--only", "passes", "--beside", str(tmp_path))
    # The symbolic link leads out of it, which is noticed
    assert "which does not lie in" in done.stderr and "failed" in done.stdout
    assert done.returncode == 0
    broken = tmp_path / "broken" / "nil_mitsuba"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("")
    done = run("benchmarks.speed", "--quick", "--only", "passes", "--beside", str(broken.parent))
    assert "failed" in done.stdout and done.returncode == 0
    done = run("benchmarks.speed", "--quick", "--only", "passes", "--beside", str(tmp_path / "no"))
    assert done.returncode == 1 and "is no checkout" in done.stderr


def test_images_of_both_tolerances_are_compared():
    done = run("benchmarks.accuracy", "--quick", "--only", "furnished cell")
    assert done.returncode == 0, done.stderr[-2000:]
    assert "mean" in done.stdout and "squares of 4x4 pixels off" in done.stdout


@pytest.mark.verify
def test_every_workload_runs():
    done = run("benchmarks.speed", "--quick")
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.verify
def test_the_viewfinder_is_timed():
    done = run("benchmarks.walk", "--frames", "3")
    assert done.returncode == 0, done.stderr[-2000:]
    rows = [line.split() for line in done.stdout.splitlines() if line.split()[1:2] == ["yes"]]
    assert [row[0] for row in rows] == ["showcase", "cornell-box"]


def test_memory_is_measured_without_that_of_who_asks():
    from benchmarks.worker import alone

    code = "import resource; print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    taken = b"x" * 2**28
    run = subprocess.run(
        alone([sys.executable, "-c", code]), capture_output=True, text=True, check=True
    )
    assert len(taken) == 2**28 and float(run.stdout) < 128
