"""Fog that the command puts into scenes; stills, parts and hashes of scenes with media."""

import math
import re
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import pytest

from command_line import BOX, LAMP, NIL, complaint, planes, read, scene
from nil_mitsuba import jobs, stills
from nil_mitsuba.fog import ALBEDO, Fog
from small_stills import description, equal

AIR = '<medium type="homogeneous"><float name="sigma_t" value="1"/></medium>'
SKY = '<emitter type="constant"/>'
CLOUD = """
    <shape type="cube">
        <transform name="to_world">
            <scale value="0.3"/><translate value="0.5, 0.5, 0.5"/>
        </transform>
        <bsdf type="null"/>
        <medium name="interior" type="heterogeneous">
            <volume name="sigma_t" type="gridvolume">
                <string name="filename" value="cloud.vol"/>
                <transform name="to_world">
                    <scale value="0.6"/><translate value="0.2, 0.2, 0.2"/>
                </transform>
            </volume>
            <float name="albedo" value="0.8"/>
            <float name="scale" value="6"/>
        </medium>
    </shape>
"""


def lines_of(err):
    """The lines for a sensor that --fog prints."""
    return re.search(r"<medium.*</medium>", err, re.DOTALL)[0]


def in_air(sensor, air=AIR):
    return sensor.replace("</sensor>", air + "</sensor>")


# ------------------------------------------------------------------------ the fog


def test_what_fog_prints_keeps_its_picture(command, folder):
    (folder / "scene.xml").write_text(scene(NIL, BOX, LAMP))
    options = ("render", "scene.xml", "-P", "cell_size=3")
    status, _, err = command(*options, "--fog", "1")
    assert status == 0, err
    air = lines_of(err)
    assert '"sigma_t" value="0.333333' in air and f'"albedo" value="{ALBEDO:g}"' in air
    foggy = planes("scene.exr")
    (folder / "scene.xml").write_text(scene(NIL, in_air(BOX, air), LAMP))
    assert command(*options)[0] == 0
    assert planes("scene.exr") == foggy


def test_fog_that_scatters_nothing_dims_by_its_density_per_cell(command, folder):
    (folder / "scene.xml").write_text(scene(NIL, BOX, LAMP))
    spp = 1024
    status, _, err = command(
        *("render", "scene.xml", "--fog", "3", "--fog-albedo", "0", "--spp", str(spp)),
        *("-P", "cell_size=1.5", "-P", "twist=0"),
    )
    assert status == 0, err
    centre = [planes("scene.exr")["R"][y][x] for y in (3, 4) for x in (5, 6)]
    # The lamp is 0.45 away, by 0.6 % less of the light at the edge of these pixels
    passed = math.exp(-0.45 * 3 / 1.5)
    error = math.sqrt(passed * (1 - passed) / (4 * spp))
    assert abs(sum(centre) / 4 - passed) < 5 * error + 0.006 * passed  # 6e-7 by chance


def test_fog_is_as_dense_as_the_fitted_cell_wants(command, folder):
    (folder / "scene.xml").write_text(scene(NIL, BOX, LAMP))
    status, _, err = command("render", "scene.xml", "--fit", "camera", "--fog", "0.5")
    assert status == 0, err
    size = read("scene.exr")[0]["cell_size"]
    assert size == pytest.approx(0.75 * (1 + 1e-3), rel=1e-6)
    (sigma_t,) = re.findall('"sigma_t" value="(.*?)"', lines_of(err))
    assert float(sigma_t) == pytest.approx(0.5 / size, rel=1e-6)


def test_fog_surrounds_every_sensor_and_batches_as_a_whole(rgb):
    parts = description(4)
    eye = {"type": "perspective", "to_world": parts["sensor"]["to_world"]}
    film = parts["sensor"]["film"] | {"width": 8}
    batch = {"type": "batch", "film": film, "left": eye, "right": eye}
    loaded = mi.load_dict(parts | {"batch": batch})
    clear = [mi.render(loaded, sensor=i, spp=64) for i in (0, 1)]
    Fog(3, 0).fill(loaded, loaded.integrator())
    for i in (0, 1):
        # Everything is at least 0.3 cells away, of which exp(-0.9) = 0.41 is left
        assert dr.mean(mi.render(loaded, sensor=i, spp=64).array) < 0.6 * dr.mean(clear[i].array)


def test_fog_changes_nothing_about_an_aim(command, folder):
    aim = ("aim", "scene.xml", "--at", "0.5,0.5,0.5")
    status, out, err = command(*aim, "--fog", "1")
    assert status == 0 and lines_of(err)
    assert (0, out, "") == command(*aim)


def test_denoising_knows_of_fog(folder, rgb):
    (folder / "scene.xml").write_text(scene(NIL, BOX, LAMP))
    opened = jobs.open_scene(jobs.Job("scene.xml", denoise=True, fog=Fog(1)))
    assert "transmittance" in opened.integrator.layers
    opened = jobs.open_scene(jobs.Job("scene.xml", denoise=True))
    assert "transmittance" not in opened.integrator.layers


@pytest.mark.parametrize(
    "options, status, fragment",
    [
        (["--fog", "-1"], 2, "-1.0 is not in the range"),
        (["--fog", "nan"], 2, '"nan" is none'),
        (["--fog", "inf"], 2, "inf is not in the range"),
        (["--fog", "thick"], 2, "'thick' is not a valid"),
        (["--fog", "1", "--fog-albedo", "1.5"], 2, "1.5 is not in the range 0<=x<=1"),
        (["--fog", "1", "--fog-albedo", "-0.5"], 2, "-0.5 is not in the range 0<=x<=1"),
        (["--fog", "1", "--fog-albedo", "nan"], 2, '"nan" is none'),
        (["--fog-albedo", "0.5"], 2, "--fog-albedo goes with --fog"),
    ],
)
@pytest.mark.parametrize(
    "verb", [["render"], ["aim", "--at", "0.5,0.5,0.5"]], ids=["render", "aim"]
)
def test_fog_that_cannot_be_is_told_in_a_sentence(
    command, folder, rendering_is_an_error, verb, options, status, fragment
):
    found, _, err = command(*verb, "scene.xml", *options)
    assert found == status and fragment in complaint(err)


@pytest.mark.parametrize(
    "parts, name",
    [
        ((in_air(BOX, AIR.replace("type", 'id="mist" type', 1)), LAMP), "mist"),
        (
            (
                BOX,
                LAMP.replace(
                    "</shape>", f"{AIR}</shape>".replace("type", 'name="exterior" type', 1)
                ),
            ),
            "homogeneous",
        ),
        ((BOX, CLOUD), "heterogeneous"),
    ],
    ids=["sensor", "exterior", "interior"],
)
def test_fog_in_a_scene_that_has_a_medium_is_refused(
    command, folder, rendering_is_an_error, parts, name
):
    (folder / "scene.xml").write_text(scene(NIL, *parts))
    status, _, err = command("render", "scene.xml", "--fog", "0.15")
    assert status == 1
    assert f'--fog is for scenes without a medium, and "scene.xml" has "{name}"' in complaint(err)


# -------------------------------------------------------------------------- stills


@pytest.fixture(params=["fog", "heterogeneous"])
def hazy(request, folder):
    """A scene that holds a medium, as options of the command."""
    parts, options = [BOX, LAMP, SKY], ["--fog", "1"]
    if request.param == "heterogeneous":
        grid = mi.VolumeGrid(mi.TensorXf([0.0, 1, 0.5, 0, 1, 0.2, 0, 1], (2, 2, 2, 1)))
        grid.write(str(folder / "cloud.vol"))
        parts.append(CLOUD)
        options = []
    (folder / "scene.xml").write_text(scene(NIL, *parts))
    return ["scene.xml", "--pass-spp", "4", *options]


def test_resumed_and_merged_stills_with_media_are_those_of_one_run(command, hazy):
    assert command("render", *hazy, "--spp", "12", "-o", "whole.exr")[0] == 0
    whole = planes("whole.exr")
    for spp in ("4", "12"):
        status, _, err = command(
            "render", *hazy, "--spp", spp, "--checkpoint", "a.sums", "--resume", "-o", "resumed.exr"
        )
        assert status == 0, err
    assert planes("resumed.exr") == whole
    for part in ("0:1", "1:3"):
        assert command("render", *hazy, "--spp", "12", "--passes", part)[0] == 0
    parts = ["scene.0-1.sums", "scene.1-3.sums"]
    assert command("merge", *parts, "-o", "merged.exr")[0] == 0
    merged = planes("merged.exr")
    for name in "RGB":
        for row, expected in zip(merged[name], whole[name]):
            assert row == pytest.approx(expected, rel=1e-6)
    for name in ("sceneHash", "passes", "fog", "fog_albedo"):
        assert read("merged.exr")[0].get(name) == read("whole.exr")[0].get(name)


def test_a_still_in_other_fog_is_not_gone_on_with(command):
    render = ("render", "scene.xml", "--spp", "8", "--checkpoint", "a.sums", "--resume")
    assert command(*render, "--fog", "0.5")[0] == 0
    for options, difference in (
        (["--fog", "0.25"], "fog is 0.5 there and 0.25 here."),
        (["--fog", "0.5", "--fog-albedo", "0.7"], f"fog_albedo is {ALBEDO} there and 0.7 here."),
        ([], f"fog is 0.5 there and none here; fog_albedo is {ALBEDO} there and none here."),
    ):
        status, _, err = command(*render, *options)
        assert status == 1
        assert err.splitlines()[-1] == f'nil-mitsuba: cannot go on with "a.sums": {difference}'
    assert command(*render, "--fog", "0.5", "--fog-albedo", str(ALBEDO))[0] == 0


def test_a_picture_tells_its_fog(command, folder):
    command("render", "scene.xml", "--fog", "0.5", "--fog-albedo", "0.7", "--checkpoint", "a.sums")
    header = read("scene.exr")[0]
    assert (header["fog"], header["fog_albedo"]) == pytest.approx((0.5, 0.7))
    for name in ("scene.exr", "a.sums"):
        assert re.search(
            r"\bfog +0\.5\n.*\bfog_albedo +0\.7\n", command("info", name)[1], re.DOTALL
        )
    command("render", "scene.xml", "-o", "clear.exr")
    assert "fog" not in read("clear.exr")[0]
    # In a wrapper, which renders in one go, too
    moment = '<integrator type="moment"><integrator type="nil"/></integrator>'
    (folder / "scene.xml").write_text(scene(moment, BOX, LAMP))
    assert command("render", "scene.xml", "--fog", "0.5")[0] == 0
    assert read("scene.exr")[0]["fog"] == pytest.approx(0.5)


def test_workers_open_a_job_to_the_same_fog(folder, rgb):
    (folder / "scene.xml").write_text(scene(NIL, BOX, LAMP))
    opened = jobs.open_scene(jobs.Job("scene.xml", spp=4, fit="camera", fog=Fog(0.5)))
    here = opened.still(stills.Rules(spp=4)).render(0)
    path = str(folder / "scene.xml")
    there = jobs.open_still(replace(opened.job, path=path))
    here.require(there.settings)
    assert equal(there.render(0).sums.values, here.sums.values)


# --------------------------------------------------------------------------- hashes


def haze(phase="isotropic", corner=0.0, density=1.0):
    """A scene in a heterogeneous medium, which the sensor names."""
    grid = mi.VolumeGrid(mi.TensorXf([0.0, 1, 0, 0, 1, 0, 0, density], (2, 2, 2, 1)))
    to_world = mi.ScalarTransform4f().translate(corner)
    volume = {"type": "gridvolume", "grid": grid, "to_world": to_world}
    parts = description()
    parts["sensor"]["medium"] = {
        "type": "heterogeneous",
        "albedo": 0.5,
        "sigma_t": volume,
        "phase": {"type": phase},
    }
    return mi.load_dict(parts)


@pytest.mark.parametrize("change", [{"phase": "rayleigh"}, {"corner": 0.1}, {"density": 0.9}])
def test_the_hash_of_a_scene_covers_the_medium_of_its_sensor(rgb, change):
    assert stills.hash_of(haze()) == stills.hash_of(haze())
    assert stills.hash_of(haze(**change)) != stills.hash_of(haze())
