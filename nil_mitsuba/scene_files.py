"""Scene files: read with "nil" in the place of another integrator, and told apart by a hash."""

from __future__ import annotations

import contextlib
import hashlib
import re
import struct
from pathlib import Path

import mitsuba as mi

from .parameters import NAMES

# The options that a scene's own integrator shares with "nil": they survive its replacement.
SHARED_PROPERTIES = ("max_depth", "rr_depth", "hide_emitters")


class SceneFiles:
    """A scene description that has been read, with "nil" in the place of another integrator.

    ``parameters`` are constants that the scene refers to, ``properties`` those of "nil", as text
    or as values. ``notes`` are sentences on what was replaced, ``files`` the paths of all files
    that the scene consists of. Raises RuntimeError or ValueError if something is wrong with it.
    """

    def __init__(self, path: str, parameters: dict[str, str], properties: dict):
        self.config = mi.parser.ParserConfig(mi.variant())
        self.notes: list[str] = []
        for name in ("config", "filename"):
            if name in parameters:  # the names of the parser's own arguments
                raise ValueError(f'-D cannot define "{name}": rename the parameter.')
        state = mi.parser.parse_file(self.config, path, **parameters)
        if state.root.type != mi.ObjectType.Scene:
            raise ValueError(f'the root element of "{path}" must be a <scene> tag.')
        mi.parser.transform_upgrade(self.config, state)
        mi.parser.transform_resolve(self.config, state)

        # Two scenes: one without the integrator, one with nothing else.
        self.rest, self.alone = state, mi.parser.ParserState(state)
        reference = self._take_integrator(path)
        self.alone.root.props = mi.Properties("scene")
        self.alone.root.props["integrator"] = reference
        self._nil = self._find_nil(reference.index()) or self._replace(reference.index(), path)
        self._set(properties)
        self.files = self._files()

    @property
    def hash(self) -> str:
        """SHA-256 of the scene and of the contents of the files that it names.

        The integrator and the number of samples are no part of it. To be asked for before
        ``scene``, which merges meshes.
        """
        text = mi.parser.write_string(mi.parser.ParserState(self.rest))
        # Mitsuba writes the number as a constant of its own
        text = re.sub(r'\s*<default name="spp"[^>]*>', "", text)
        digest = hashlib.sha256(text.encode())
        for path in self.files[len(self.rest.files) :]:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()

    def integrator(self, **properties):
        """The integrator by itself, with further properties of "nil" set."""
        self._set(properties)
        # A copy, since references become the objects that are made
        copy = mi.parser.ParserState(self.alone)
        return mi.parser.instantiate(self.config, copy).integrator()

    def nil(self):
        """The integrator "nil" itself, which a wrapper may hold."""
        given = {name: self._nil.props[name] for name in NAMES if name in self._nil.props}
        return mi.load_dict({"type": "nil"} | given)

    def use_box_filter(self) -> None:
        """Let each pixel hold its own samples only, as denoising needs; says so in `notes`."""
        nodes, kind = self.rest.nodes, mi.ObjectType.ReconstructionFilter
        for i in range(len(nodes)):
            if nodes[i].type != mi.ObjectType.Film:
                continue
            props = nodes[i].props
            filters = [key for key, index in children(props) if nodes[index].type == kind]
            names = [nodes[props[key].index()].props.plugin_name() for key in filters]
            if names == ["box"]:
                continue
            for key in filters:
                del props[key]
            box = mi.parser.SceneNode()
            box.type, box.props = kind, mi.Properties("box")
            # Before the list grows: references to its nodes do not outlive that.
            props["rfilter"] = mi.Properties.ResolvedReference(len(nodes))
            nodes.append(box)
            self.notes.append(
                f'--denoise: the film\'s filter "{(names or ["gaussian"])[0]}" is replaced by '
                '"box", since noise that pixels share cannot be removed.'
            )

    def media(self) -> list[str]:
        """What tells each medium of the scene: its id, or its type where it has none."""
        all_props = (node.props for node in self.rest.nodes if node.type == mi.ObjectType.Medium)
        return [props.id() or props.plugin_name() for props in all_props]

    def scene(self, merge: bool = True):
        """The scene without its integrator; ``merge`` makes one mesh of many, which is faster."""
        if merge:
            mi.parser.transform_merge_equivalent(self.config, self.rest)
            mi.parser.transform_merge_meshes(self.config, self.rest)
        return mi.parser.instantiate(self.config, self.rest)

    def _set(self, properties: dict) -> None:
        for name, value in properties.items():
            self._nil.props[name] = parse_value(value) if isinstance(value, str) else value

    def _files(self) -> list[Path]:
        """The scene's own files, and those that its properties name."""
        found = dict.fromkeys(Path(str(name)) for name in self.rest.files)
        # A copy, since a property that was looked at no longer counts as unknown
        for node in mi.parser.ParserState(self.rest).nodes:
            for key in node.props.keys():
                value = node.props[key]
                if isinstance(value, str) and value:
                    path = Path(str(mi.file_resolver().resolve(value)))
                    if path.is_file():
                        found[path] = None
        return list(found)

    def _take_integrator(self, path: str):
        """Take the integrator out of the scene; a reference to its node among `alone`'s."""
        nodes, root = self.alone.nodes, self.rest.root.props
        own = [
            key for key, index in children(root) if nodes[index].type == mi.ObjectType.Integrator
        ]
        if len(own) > 1:
            raise ValueError(f'"{path}": only one integrator can be specified per scene.')
        if own:
            reference = root[own[0]]
            del root[own[0]]
            return reference

        self.notes.append(f'{path} has no integrator: rendering with "nil".')
        node = mi.parser.SceneNode()
        node.type = mi.ObjectType.Integrator
        node.props = mi.Properties("nil")
        nodes.append(node)
        return mi.Properties.ResolvedReference(len(nodes) - 1)

    def _find_nil(self, index: int):
        """The node of "nil" at or below an integrator's node: wrappers hold others."""
        node = self.alone.nodes[index]
        if node.props.plugin_name() == "nil":
            return node
        for _, child in children(node.props):
            found = self._find_nil(child)
            if found is not None:
                return found
        return None

    def _replace(self, index: int, path: str):
        node, props = self.alone.nodes[index], mi.Properties("nil")
        for name in SHARED_PROPERTIES:
            if name in node.props:
                props[name] = node.props[name]
        name = node.props.plugin_name()
        self.notes.append(f'{path}: the integrator "{name}" is replaced by "nil".')
        node.props = props
        return node


def children(props) -> list[tuple[str, int]]:
    """Names and node numbers of the objects below a node."""
    values = ((key, props[key]) for key in props.keys())
    return [
        (key, value.index())
        for key, value in values
        if isinstance(value, mi.Properties.ResolvedReference)
    ]


def parse_value(text: str):
    """The value of a property from the command line: boolean, number, vector "x,y,z" or string."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(text)
    with contextlib.suppress(ValueError):
        x, y, z = map(float, text.split(","))
        return mi.ScalarVector3d(x, y, z)
    return text


def number_text(number: float) -> str:
    """A float32 with as many digits as give it back."""
    for digits in range(6, 10):  # 9 digits always do
        text = f"{number + 0.0:.{digits}g}"  # + 0.0: a zero has no sign
        if struct.pack("f", float(text)) == struct.pack("f", number):
            break
    return text
