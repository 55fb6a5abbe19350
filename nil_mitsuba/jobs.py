"""Jobs, which say what to render in plain values, and the one way in which all processes open them.

The command, its workers and those of a cluster open the same job: they cannot disagree on a scene.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from .fitting import fit, unfitted
from .fog import Fog
from .frames import Frames, Plan
from .layers import GUIDES
from .scene_files import SceneFiles
from .stills import Rules, Still

CELL = {"cell_origin", "cell_size"}  # who sets these has fitted the cell


@dataclass(frozen=True)
class Job:
    """What to render, in plain values that can be sent to another process.

    ``path`` is that of the scene file, where the process finds it; ``properties`` are those of
    "nil", the layers among them ("aovs"). ``spp`` and ``pass_spp`` (samples per pixel, of the image
    and of a pass) may be None, for the scene's and for as many as fit; ``scene_hash`` too, for
    whatever lies there. ``denoise`` asks for what denoising needs: a film with the filter "box" and
    the layers that guide it. ``fit`` names what the cell is fitted to, as in ``fitting.FITS``;
    None leaves it as it is. ``fog`` fills the space around the sensors, if it is not None.
    ``flight`` asks for frames, in the place of passes.
    """

    path: str
    variant: str = "llvm_ad_rgb"
    defines: dict[str, str] = field(default_factory=dict)
    properties: dict[str, str] = field(default_factory=dict)
    sensor: int = 0
    seed: int = 0
    spp: int | None = None
    pass_spp: int | None = None
    scene_hash: str | None = None
    denoise: bool = False
    fit: str | None = None
    fog: Fog | None = None
    flight: Plan | None = None


class Opened(NamedTuple):
    """A job's scene and integrator, loaded.

    ``job`` is the job with all that loading has found out: it opens to the same scene, or not at
    all. ``nil`` is the integrator, or what that wraps. ``layers`` are those that were asked for,
    which denoising may have added to.
    """

    job: Job
    scene: mi.Scene
    integrator: mi.Integrator
    nil: mi.Integrator
    layers: tuple[str, ...]

    def still(self, rules: Rules) -> Still:
        """What is to be rendered; raises ValueError if the integrator is not "nil" itself."""
        job = self.job
        return Still(
            self.scene,
            job.sensor,
            self.integrator,
            job.seed,
            rules,
            job.pass_spp,
            job.scene_hash,
            job.fog,
        )


def open_scene(
    job: Job, note: Callable[[str], None] = lambda _: None, aiming: bool = False
) -> Opened:
    """Load a job's scene; sets the job's variant.

    ``note`` is told, in sentences, what differs from the scene file. For ``aiming`` meshes keep
    their ids, which takes longer to render, and no one is told to aim. Raises ValueError,
    RuntimeError or OSError with a sentence if the scene cannot be loaded, or if it is not the one
    with the job's hash.
    """
    mi.set_variant(job.variant)
    with _beside(job.path), _enough_threads():
        files = SceneFiles(job.path, job.defines, job.properties)
        foreign = bool(files.notes)  # not written for "nil", which was put into it
        if job.denoise:
            files.use_box_filter()
        for sentence in files.notes:
            note(sentence)

        media = files.media()
        if job.fog and media:
            raise ValueError(
                f'--fog is for scenes without a medium, and "{job.path}" has "{media[0]}": leave '
                "--fog away, or the medium."
            )
        # The integrator's parameters are checked before large meshes are loaded
        integrator = files.integrator()
        scene_hash = files.hash
        if job.scene_hash not in (None, scene_hash):
            raise ValueError(f'"{job.path}" or a file that it names differs from the one expected.')
        layers = getattr(integrator, "layers", ())
        # Merged meshes have no numbers of their own
        scene = files.scene(merge=not aiming and "shape" not in layers)
        sensors = scene.sensors()
        if not sensors:
            raise ValueError(f'the scene "{job.path}" has no sensor.')
        if job.sensor >= len(sensors):
            raise ValueError(
                f'the scene "{job.path}" has no sensor {job.sensor}: its sensors are numbered '
                f"from 0 to {len(sensors) - 1}."
            )
        further: dict[str, str] = {}
        advice = None
        if job.fit:
            chosen = sorted(CELL & job.properties.keys())
            if chosen:
                raise ValueError(
                    f"--fit finds cell_size and cell_origin itself, and -P gives {chosen[0]}: give "
                    "one of the two."
                )
            fitted = fit(scene, sensors[job.sensor], files.nil(), job.fit)
            further |= fitted.properties
            integrator = files.integrator(**further)
            for sentence in fitted.notes:
                note(sentence)
            if fitted.aim and not aiming:
                note(fitted.aim)
        elif foreign and not CELL & job.properties.keys():
            advice = unfitted(scene, sensors[job.sensor], files.nil())
            if advice:
                note(f"{job.path}: {advice}")
        if job.fog:
            # Cells are as large as they have been fitted
            note(job.fog.fill(scene, files.nil()))
        if job.denoise:
            from .media import has_media  # needs a variant

            guides = (
                *GUIDES,
                *(["transmittance"] if has_media(scene, sensors[job.sensor]) else []),
            )
            further["aovs"] = ",".join(dict.fromkeys((*layers, *guides)))
            integrator = files.integrator(**further)
        if advice and hasattr(integrator, "view"):
            integrator.cell_is_known = True
    job = replace(job, properties=job.properties | further, scene_hash=scene_hash, fit=None)
    return Opened(job, scene, integrator, files.nil(), layers)


def open_still(job: Job) -> Still:
    """The still that a job describes; raises what ``open_scene`` does."""
    return open_scene(job).still(Rules(spp=job.spp))


def render_part(job: Job, first: int, stop: int) -> bytes:
    """Passes ``first`` to ``stop`` − 1 of a job, as the contents of a checkpoint file; of a
    flight's job the frame ``first``.

    The scene of the last job stays loaded in this process.
    """
    if _opened.get("job") != job:
        _opened.clear()
        if job.flight:
            _opened.update(frames=Frames(open_scene(job), job.flight))
        else:
            _opened.update(still=open_still(job))
        _opened.update(job=job)
    if job.flight:
        return _opened["frames"].render(first).to_bytes()
    still = _opened["still"]
    state = still.nothing()
    for index in range(first, stop):
        state = state.plus(still.render(index))
    return state.to_bytes()


_opened: dict = {}


@contextlib.contextmanager
def _beside(path: str) -> Iterator[None]:
    """Names of files mean those in the folder of the scene first, and in no earlier scene's."""
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(os.path.dirname(path) or ".")
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


@contextlib.contextmanager
def _enough_threads() -> Iterator[None]:
    """Mitsuba 3.9 waits for ever for an EXR texture if there is no worker thread to read it."""
    before = dr.thread_count()
    dr.set_thread_count(max(before, 2))
    try:
        yield
    finally:
        dr.set_thread_count(before)
