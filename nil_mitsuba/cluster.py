"""Passes of a still, or frames, on many machines: handed to a Dask cluster and taken back as they
come."""

from __future__ import annotations

import contextlib
import logging
import platform
import signal
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi

try:
    import distributed
    from distributed.comm import CommClosedError
    from distributed.utils import silence_logging_cmgr
    from distributed.versions import VersionMismatchWarning
except ModuleNotFoundError:
    raise ModuleNotFoundError(
        "--scheduler and --workers need the package distributed: pip install 'nil-mitsuba[cluster]'"
    ) from None

from . import jobs, stills
from .checkpoint import Checkpoint
from .jobs import Job
from .sums import name_passes

# A part is rendered while the next one waits: no worker is idle, and little is lost on stopping.
PARTS_AHEAD = 2

# Rendering of a part takes about so long: sums of 4K are half a gigabyte, so that a network of
# 1 Gbit/s has done with them in half of that, and between parts rules and signals are looked at.
PART_SECONDS = 10.0

# Without a part for so long, rules and signals are looked at all the same.
LOOK_SECONDS = 2.0

# A scheduler that is there answers within milliseconds.
CONNECT_SECONDS = 10.0

# Time for a part to come from a worker before others are looked at: 4K at 100 Mbit/s.
TRANSFER_SECONDS = 60.0

# A part whose worker dies goes to others, as often as Dask itself would send it again.
LOSSES = 3

# Dr.Jit uses all processors for one task: more at once would only take more memory.
_one_at_a_time = ThreadPoolExecutor(1)


class Refused(Exception):
    """The worker at ``address`` cannot render the passes; ``sentence`` says why."""

    def __init__(self, address: str, sentence: str):
        super().__init__(address, sentence)
        self.address, self.sentence = address, sentence


def render(
    still: stills.Still,
    job: Job,
    indices: Iterable[int],
    scheduler: str | None = None,
    workers: int = 1,
    threads: int | None = None,
    complain: Callable[[str], None] = print,
) -> Generator[Checkpoint, None, None]:
    """Passes of `still`, which `job` describes, rendered by the cluster at ``scheduler``.

    Without a scheduler, ``workers`` processes are started here. Yields parts as they come, in any
    order, and every few seconds without one a part that holds no pass. ``threads`` are those of
    each worker. What does not end the rendering is told to ``complain``. Raises OSError if there is
    no such cluster (any more), or if passes end every worker that takes them, and ValueError if no
    worker can render them.
    """
    left = None if still.count is None else len(indices := list(indices))
    queue = Queue(indices, left)
    with _parts(job, queue, scheduler, workers, threads, complain) as parts:
        for data in parts:
            yield still.nothing() if data is None else Checkpoint.from_bytes(data, "a part")


def render_frames(
    job: Job,
    indices: list[int],
    scheduler: str | None = None,
    workers: int = 1,
    threads: int | None = None,
    complain: Callable[[str], None] = print,
) -> Generator[Checkpoint | None, None, None]:
    """Frames of the flight of a job, each rendered by one worker; otherwise as ``render``.

    Yields None every few seconds without a frame.
    """
    queue = Queue(indices, len(indices), most=1)
    with _parts(job, queue, scheduler, workers, threads, complain) as parts:
        for data in parts:
            yield None if data is None else Checkpoint.from_bytes(data, "a frame")


@contextlib.contextmanager
def _parts(
    job: Job,
    queue: Queue,
    scheduler: str | None,
    workers: int,
    threads: int | None,
    complain: Callable[[str], None],
) -> Iterator[Iterator[bytes | None]]:
    if scheduler is None and threads is None:
        threads = max(1, dr.thread_count() // workers)
    with _connected(scheduler, workers) as client:
        with contextlib.closing(Hands(client, job, queue, threads, complain).parts()) as parts:
            yield parts


class Queue:
    """Passes that are to be handed out, in ranges; ``left`` of them, None if there is no end.

    Frames, too, which come one by one: there are ``most`` in a range.
    """

    def __init__(self, indices: Iterable[int], left: int | None, most: int | None = None):
        self.indices = iter(indices)
        self.next = next(self.indices, None)
        self.left = left
        self.most = most
        self.again: list[tuple[int, int]] = []

    def __bool__(self) -> bool:
        return bool(self.again) or self.next is not None

    def take(self, most: int) -> tuple[int, int]:
        """The next range, of up to `most` passes, or one that has been put back."""
        if self.again:
            return self.again.pop(0)
        if self.next is None:
            raise IndexError("there are no passes left")
        first = stop = self.next
        while stop == self.next and stop - first < most:
            stop += 1
            self.next = next(self.indices, None)
        if self.left is not None:
            self.left -= stop - first
        return first, stop

    def size(self, workers: int, seconds: float | None) -> int:
        """Passes in the next part, if one takes so many seconds (None: not known yet).

        Towards the end they become fewer, so that all workers are busy until then.
        """
        size = 1 if seconds is None else max(1, int(PART_SECONDS / max(seconds, 1e-3)))
        if self.left is not None:
            size = min(size, max(1, self.left // (PARTS_AHEAD * workers)))
        return min(size, self.most or size)


class Hands:
    """The workers of a cluster: parts go to those that fit, and come back in any order."""

    def __init__(
        self, client, job: Job, queue: Queue, threads: int | None, complain: Callable[[str], None]
    ):
        self.client, self.job, self.queue, self.threads = client, job, queue, threads
        self.complain = complain
        self.versions = versions()
        self.fit: set[str] = set()  # Addresses of workers that are there and fit
        self.refused: dict[str, str] = {}  # Those that do not, and why
        self.flying: dict = {}  # Passes and workers of each future
        self.losses: dict[tuple[int, int], int] = {}
        self.seconds: float | None = None  # Of a pass, once one has come
        self.waiting = False

    def parts(self) -> Generator[bytes | None, None, None]:
        """Contents of parts as they come; None if nothing has come for a while."""
        try:
            while True:
                self._look()
                self._fill()
                if not (self.flying or self.queue):
                    return
                done = self._done()
                if not done:
                    yield None
                for future in done:
                    data = self._take_back(future)
                    if data is not None:
                        yield data
        except (distributed.CancelledError, CommClosedError):
            resume = "" if self.job.flight else " with --resume"
            raise OSError(
                "the connection to the cluster's scheduler is lost: the same command"
                f"{resume} goes on."
            ) from None
        finally:
            with contextlib.suppress(Exception):  # There may be no scheduler any more
                self.client.cancel(list(self.flying), force=True)

    def _look(self) -> None:
        """See who is there; hand out again what only workers that are gone could render."""
        present = set(self.client.nthreads())
        new = present - self.fit - self.refused.keys()
        self.fit &= present
        if new:
            answers = self.client.run(versions, workers=list(new), on_error="return")
            for address, answer in answers.items():
                if isinstance(answer, dict):
                    sentence = difference(answer, self.versions)
                elif isinstance(answer, OSError):
                    continue  # It is gone already, or will be asked again
                else:
                    sentence = f"it has no nil_mitsuba that can be loaded ({answer})"
                if sentence:
                    self._refuse(address, sentence)
                else:
                    self.fit.add(address)
        if not self.fit and self.seconds is None:
            if self.refused:
                raise ValueError(
                    "no worker of the cluster can render this: "
                    + "; ".join(
                        f"{address}: {sentence}" for address, sentence in self.refused.items()
                    )
                    + "."
                )
            if not new:
                raise OSError('the cluster has no workers: start some with "dask worker".')
        if not self.fit and not self.waiting:
            self.complain("no worker is left that can render this: waiting for one to come.")
        self.waiting = not self.fit
        for future, (part, workers) in list(self.flying.items()):
            if not (workers & present or future.done()):
                del self.flying[future]
                future.cancel(force=True)
                self._lost(part)

    def _fill(self) -> None:
        while self.queue and len(self.flying) < PARTS_AHEAD * len(self.fit):
            part = self.queue.take(self.queue.size(len(self.fit), self.seconds))
            future = self.client.submit(
                render_part, self.job, *part, self.threads, workers=sorted(self.fit), pure=False
            )
            self.flying[future] = part, frozenset(self.fit)

    def _done(self) -> set:
        """Futures that are done, as soon as one is; none after `LOOK_SECONDS`."""
        if not self.flying:
            time.sleep(LOOK_SECONDS)
            return set()
        try:
            return distributed.wait(list(self.flying), LOOK_SECONDS, "FIRST_COMPLETED").done
        except distributed.TimeoutError:
            return set()

    def _take_back(self, future) -> bytes | None:
        """A part's contents; None if its worker has refused or lost it."""
        part, _ = self.flying[future]
        try:
            seconds, data = future.result(TRANSFER_SECONDS)
        except Refused as error:
            self._refuse(error.address, error.sentence)
            self.queue.again.append(part)
            data = None
        except distributed.TimeoutError:
            return None  # It stays where it is
        except distributed.KilledWorker as error:
            raise OSError(self._killing(part, error.last_worker.address)) from None
        else:
            self.seconds = seconds / (part[1] - part[0])
        del self.flying[future]
        return data

    def _refuse(self, address: str, sentence: str) -> None:
        if address not in self.refused:
            self.complain(f"{address} is left out: {sentence}.")
        self.refused[address] = sentence
        self.fit.discard(address)

    def _lost(self, part: tuple[int, int]) -> None:
        self.losses[part] = self.losses.get(part, 0) + 1
        if self.losses[part] > LOSSES:
            raise OSError(self._killing(part))
        self.queue.again.append(part)

    def _killing(self, part: tuple[int, int], address: str | None = None) -> str:
        last = f", the last of them {address}" if address else ""
        what = f"frame {part[0]}" if self.job.flight else f"passes {name_passes([part])}"
        return (
            f"every worker that took the {what} ended{last}: its log may say why; too little "
            "memory is a common reason."
        )


# -------------------------------------------------------------------- on workers


def render_part(job: Job, first: int, stop: int, threads: int | None) -> tuple[float, bytes]:
    """Seconds that rendering took, and what `jobs.render_part` returns; raises Refused."""
    try:
        return _one_at_a_time.submit(_render_part, job, first, stop, threads).result()
    except (ValueError, RuntimeError, OSError) as error:
        raise Refused(distributed.get_worker().address, str(error).rstrip(".")) from None


def versions() -> dict[str, str]:
    """Versions that have to be the same everywhere."""
    python = ".".join(platform.python_version_tuple()[:2])
    return stills.versions() | {"Dask": distributed.__version__, "Python": python}


def dask_setup(_worker) -> None:
    """Called in worker processes that are started here."""
    # Ctrl-C reaches all processes of a terminal, and the first of them decides what it means
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What Mitsuba warns of, the command itself has said
    mi.set_log_level(mi.LogLevel.Error)


def _render_part(job, first, stop, threads):
    dr.set_thread_count(threads or dr.thread_count())
    start = time.perf_counter()
    data = jobs.render_part(job, first, stop)
    return time.perf_counter() - start, data


# --------------------------------------------------------------------- sentences


def difference(theirs: dict[str, str], ours: dict[str, str]) -> str:
    """What a worker would need, as a sentence without an end; "" if it has the same versions."""
    return ", ".join(
        f"it has {name} {theirs.get(name, 'of no version')}, and here is {version}"
        for name, version in ours.items()
        if theirs.get(name) != version
    )


# -------------------------------------------------------------------- connection


@contextlib.contextmanager
def _connected(scheduler: str | None, workers: int):
    """A client of the cluster at an address, or of one of so many processes here."""
    with contextlib.ExitStack() as stack:
        # What matters is said in sentences here
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL))
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore", VersionMismatchWarning)
        if scheduler is None:
            # No limit of memory: passes have theirs
            scheduler = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    memory_limit=None,
                    dashboard_address="127.0.0.1:0",
                    preload=__name__,
                    silence_logs=logging.CRITICAL,
                )
            )
        try:
            client = distributed.Client(scheduler, timeout=CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise OSError(
                f'no Dask scheduler answers at "{scheduler}" (start one with "dask scheduler", '
                f"which says its address): {error}"
            ) from None
        yield stack.enter_context(client)
