"""Every code block of the README and of the pages in docs/ runs, at a small size; links lead
somewhere."""

import re
import shlex
import shutil
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

from conftest import ENVIRONMENT
from nil_mitsuba import keys, look_at
from nil_mitsuba.fog import Fog

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
HOUSE = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s#]*)#?([^)\s]*)\)")


def read(page):
    return page.read_text(encoding="utf-8")


BLOCKS = [block for page in PAGES for block in BLOCK.findall(read(page))]

# Programs that another test runs at a small size.
TESTED_BY = {
    "benchmarks.chart": "test_chart.py",
    "benchmarks.reference_geometry": "test_geometry.py",
    "examples/render_from_python.py": "test_examples.py",
    "examples/walk.py": "test_examples.py",
    "examples/twist.py": "test_examples.py",
    "examples/light_images.py": "test_examples.py",
    "examples/own_mesh.py": "test_examples.py",
    "examples/all_around.py": "test_examples.py",
    "benchmarks.speed": "test_benchmarks.py",
}
QUICK = (
    "benchmarks.camera_rays",
    "benchmarks.accuracy",
    "benchmarks.conjugate_points",
    "benchmarks.emitter_sampling",
    "benchmarks.stills",
)


def blocks(language):
    """Code of a language, once where pages share it."""
    return list(dict.fromkeys(text for name, text in BLOCKS if name == language))


def printed_by(block):
    """What a page says that commands print: the text right behind them, if there is one."""
    language, text = [*BLOCKS, ("", "")][BLOCKS.index(("sh", block)) + 1]
    return text if language == "text" else ""


def headings(page):
    """The anchors of a page, as GitHub makes them."""
    found = re.findall(r"^#+ (.*)$", BLOCK.sub("", read(page)), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in found}


def links(page):
    """The files and anchors that a page names."""
    for path, anchor in LINK.findall(BLOCK.sub("", read(page))):
        if not path.startswith("http"):
            yield (page.parent / path).resolve() if path else page, anchor


def lines(block):
    """The commands of a shell block, without comments."""
    found = [re.sub(r"\s+#.*", "", line).strip() for line in block.splitlines()]
    return [line for line in found if line and not line.startswith("#")]


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with the README's first scene and links to what its commands read."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(ROOT / "scenes", folder / "scenes")  # pictures are written beside scenes
    for name in (
        "examples",
        "benchmarks",
        "tests",
        "nil_mitsuba",
        "Makefile",
        "pyproject.toml",
        "README.md",
        "docs",  # pictures of its scene go elsewhere
    ):
        (folder / name).symlink_to(ROOT / name)
    (folder / "hello.xml").write_text(blocks("xml")[0])
    return folder


def run(desk, arguments):
    result = subprocess.run(
        arguments, cwd=desk, capture_output=True, text=True, timeout=600, env=ENVIRONMENT
    )
    assert result.returncode == 0, f"{shlex.join(map(str, arguments))}\n{result.stderr[-2000:]}"
    return result.stdout + result.stderr


def test_the_readme_is_short_and_shows_code_of_each_kind():
    assert len(README.read_bytes()) < 10_000
    assert {"sh", "xml", "python"} <= {language for language, _ in BLOCK.findall(read(README))}


def test_no_block_is_of_a_language_that_nothing_runs():
    assert {language for language, _ in BLOCKS} <= {"sh", "xml", "python", "json", "text", "bibtex"}


@pytest.mark.parametrize("page", HOUSE, ids=lambda page: page.name)
def test_links_lead_to_files_and_headings_that_exist(page):
    for path, anchor in links(page):
        assert path.exists(), path
        assert not anchor or anchor in headings(path), f"{path.name}#{anchor}"


def test_every_page_is_linked_from_the_readme():
    assert set(PAGES) - {README} <= {path for path, _ in links(README)}


def test_the_first_scene_is_aimed_at_its_ball(rgb):
    scene = mi.load_string(blocks("xml")[0])
    aim = look_at(scene, [0.1, 0.1, 0.6], [0.5, 0.5, 0.5])
    placed = scene.sensors()[0].world_transform().matrix
    assert dr.allclose(placed, mi.Matrix4f(aim.to_world.matrix), atol=1e-3)


def test_the_lines_of_air_are_those_of_fog(rgb):
    first, air = blocks("xml")[:2]
    scene = mi.load_string(first)
    assert " ".join(air.split()) in " ".join(Fog(0.15).fill(scene, scene.integrator()).split())
    scene = mi.load_string(first.replace("</sensor>", f"{air}</sensor>"))
    assert scene.sensors()[0].get_medium() is not None


@pytest.mark.parametrize("text", blocks("xml"))
def test_xml_is_whole(text):
    ElementTree.fromstring(text)


@pytest.mark.parametrize("text", blocks("json"))
def test_json_is_a_key_file(text, tmp_path):
    path = tmp_path / "keys.json"
    path.write_text(text)
    assert keys.load(path)


@pytest.mark.parametrize("text", blocks("python"))
def test_python_runs(desk, text):
    small = re.sub(r"\b256\b", "16", text).replace("noise=0.1", "noise=0.5")
    run(desk, [sys.executable, "-c", small])


@pytest.mark.parametrize("block", blocks("sh"), ids=lambda block: lines(block)[0])
def test_commands_run(desk, block):
    printed = [run_small(desk, line) for line in lines(block)]
    assert " ".join(printed_by(block).split()) in " ".join(" ".join(printed).split())


def look(desk, arguments):
    """Run the viewfinder until it says where its page is; Ctrl-C ends it."""
    with subprocess.Popen(
        arguments, cwd=desk, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
    ) as process:
        url = process.stdout.readline()
        process.send_signal(signal.SIGINT)
    assert process.returncode == 0 and url.startswith("http://127.0.0.1:")
    return url


def run_small(desk, line):
    program, *words = shlex.split(line)
    command = [sys.executable, "-c", "from nil_mitsuba.cli import main; main()"]
    if program == "make":
        return run(desk, ["make", "--dry-run", *words])
    elif program == "pip":
        # tests/test_package.py installs the wheel; here, that there are such extras
        project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
        extras = re.findall(r"\[([\w,]+)\]", words[-1])
        assert words[0] == "install" and extras
        assert all(
            re.search(rf"^{name} = \[", project, re.MULTILINE) for name in extras[0].split(",")
        )
    elif program == "nil-mitsuba" and words[0] == "render":
        # Scenes of the project take their size as parameters; the README's own is small
        size = [] if "hello.xml" in words else ["-D", "resx=32", "-D", "resy=18"]
        return run(desk, [*command, *words, *size, "--spp", "2"])
    elif program == "nil-mitsuba" and words[0] == "view":
        return look(desk, [*command, *words, "--no-browser"])
    elif program == "nil-mitsuba" and words[0] == "fly":
        size = ["-D", "resx=32", "-D", "resy=18", "--spp", "2", "--frames", "2"]
        return run(desk, [*command, *words, *size])
    elif program == "ffmpeg":
        return ""  # not everyone's
    elif program == "nil-mitsuba":
        return run(desk, [*command, *words])
    elif program == "python" and words[-1] in TESTED_BY:
        name = Path(words[-1].removeprefix("benchmarks.")).stem
        assert name in (ROOT / "tests" / TESTED_BY[words[-1]]).read_text(encoding="utf-8")
    elif program == "python" and words[-1] in QUICK:
        return run(desk, [sys.executable, *words, "--quick"])
    else:
        pytest.fail(f"no way to run {line!r} at a small size: add one")
    return ""
