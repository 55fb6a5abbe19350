"""Checkpoints: what is kept, when it is written, and which ones are refused."""

import resource

import mitsuba as mi
import pytest

import nil_mitsuba
from nil_mitsuba import checkpoint, stills
from small_stills import description, equal, still_of, sums_of


def test_a_checkpoint_is_not_overwritten_by_accident(small, tmp_path):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, spp=16, checkpoint=path)
    contents = path.read_bytes()
    with pytest.raises(FileExistsError, match="resume"):
        nil_mitsuba.render(small, spp=16, checkpoint=path)
    assert path.read_bytes() == contents


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_what_a_callback_raises_loses_no_pass(small, tmp_path, error):
    def fail(progress):
        if progress.passes == 2:
            raise error("of its own")

    path = tmp_path / "a.sums"
    with pytest.raises(error, match="of its own"):
        nil_mitsuba.render(small, spp=96, noise=1e-9, checkpoint=path, progress=fail)
    assert checkpoint.load(path).sums.passes == ((0, 2),)


CHANGES = {
    "twist": (lambda: mi.load_dict(description(twist=2)), {}, "twist is 1.0 there and 2.0 here"),
    "fibres": (lambda: mi.load_dict(description(fibres="y")), {}, "fibres is z there and y here"),
    "size": (lambda: mi.load_dict(description(9)), {}, "size is 8,8 there and 9,9 here"),
    "layers": (lambda: mi.load_dict(description(aovs="shape")), {}, "layers is none there"),
    "seed": (lambda: mi.load_dict(description()), {"seed": 1}, "seed is 0 there and 1 here"),
    "scene": (
        lambda: mi.load_dict(description() | {"sky": {"type": "constant", "radiance": 0.2}}),
        {},
        "the scene or a file that it names has changed",
    ),
}


@pytest.mark.parametrize("what", CHANGES)
def test_the_checkpoint_of_another_still_is_refused_in_a_sentence(small, tmp_path, what):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, spp=16, checkpoint=path)
    contents = path.read_bytes()
    make, arguments, sentence = CHANGES[what]
    with pytest.raises(ValueError, match=f"cannot go on with .*{sentence}"):
        nil_mitsuba.render(make(), spp=32, checkpoint=path, resume=True, **arguments)
    assert path.read_bytes() == contents


def test_the_checkpoint_of_another_version_is_refused_in_a_sentence(small, tmp_path, monkeypatch):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, spp=16, checkpoint=path)
    monkeypatch.setattr(stills, "__version__", "9.9")
    with pytest.raises(ValueError, match="cannot go on with .*nil_mitsuba is .* and 9.9 here"):
        nil_mitsuba.render(small, spp=32, checkpoint=path, resume=True)


def test_damaged_checkpoints_are_refused_in_a_sentence(small, tmp_path):
    path = tmp_path / "a.sums"
    nil_mitsuba.render(small, spp=16, checkpoint=path)
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[-1000] ^= 1
    for contents in (whole[:-1], whole[:100], whole[:25], bytes(flipped), whole + b"\0"):
        path.write_bytes(contents)
        with pytest.raises(ValueError, match='a.sums" is damaged'):
            nil_mitsuba.render(small, spp=32, checkpoint=path, resume=True)
    for contents in (b"", b"something else"):
        path.write_bytes(contents)
        with pytest.raises(ValueError, match='a.sums" is no checkpoint'):
            nil_mitsuba.render(small, spp=32, checkpoint=path, resume=True)


def test_a_checkpoint_is_read_as_it_was_written(rgb):
    still = still_of(mi.load_dict(description(aovs="distance, cell, samples")))
    state = sums_of(still, 0, 2)
    state.seconds, state.about = 0.1, {"scene": "Größe \ud800"}
    back = checkpoint.Checkpoint.from_bytes(state.to_bytes())
    assert (back.settings, back.seconds, back.about) == (state.settings, 0.1, state.about)
    assert back.sums.passes == ((0, 1), (2, 3))
    for name in ("values", "moments", "points"):
        assert equal(getattr(back.sums, name), getattr(state.sums, name))


@pytest.mark.parametrize("pass_seconds, write_seconds", [(0.3, 0.1), (7, 2), (25, 6), (40, 1)])
def test_a_checkpoint_is_never_older_than_a_minute(monkeypatch, pass_seconds, write_seconds):
    now, state_at, saved_at, oldest = [0.0], [0.0], [0.0], [0.0]

    def write(_path, _state):
        now[0] += write_seconds
        oldest[0] = max(oldest[0], now[0] - saved_at[0])
        saved_at[0] = state_at[0]

    monkeypatch.setattr(stills.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(checkpoint, "save", write)
    saver = stills.Saver("a.sums", pytest.fail)
    writes = 0
    while now[0] < 1000:
        now[0] += pass_seconds
        state_at[0] = now[0]
        before = now[0]
        saver.after_pass(None)
        writes += now[0] > before
    # The first writing takes by surprise
    assert oldest[0] <= 60 + write_seconds
    assert writes <= 1000 / (60 - 2 * pass_seconds - 2 * write_seconds) if pass_seconds < 20 else 1


def test_a_full_disk_costs_no_samples(small, tmp_path, monkeypatch):
    path = tmp_path / "a.sums"
    whole = nil_mitsuba.render(small, spp=64, noise=1e-9)
    nil_mitsuba.render(small, spp=16, noise=1e-9, checkpoint=path)
    contents = path.read_bytes()
    monkeypatch.setattr(stills, "CHECKPOINT_SECONDS", 0.0)  # after each pass
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.warns(UserWarning, match='cannot write ".*a.sums": File too large') as warned:
            image = nil_mitsuba.render(small, spp=64, noise=1e-9, checkpoint=path, resume=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(warned) == 1
    assert equal(image, whole)
    assert path.read_bytes() == contents and list(tmp_path.iterdir()) == [path]
