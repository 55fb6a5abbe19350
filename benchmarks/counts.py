"""What a tracer asks of Embree: rays, queries and packet iterations, by kind of ray.

A query is one lane of a call in which it is active. A packet iteration is one packet of lanes, as
many as the processor's vectors have, of which one at least is active in a call: what the
instructions around a query are paid for, however few of the lanes need them.
"""

import contextlib
import re

import drjit as dr
import mitsuba as mi

# Rays whose hits are seen, in the camera or in mirrors and glass; rays behind rough bounces; rays
# towards lights
KINDS = ("seen", "soft", "shadow")


def packet_width():
    """Lanes of the vectors that Dr.Jit's kernels compute with."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.eval(dr.sin(dr.arange(mi.Float, 1000)))
        dr.sync_thread()
        text = "".join(kernel["ir"].getvalue() for kernel in dr.kernel_history())
    return max(int(width) for width in re.findall(r"<(\d+) x float>", text))


class Counts:
    """Sums over everything that is traced while this counts, by kind of ray."""

    def __init__(self):
        self.width = packet_width()
        self.rays, self.queries, self.packets = (dr.zeros(mi.UInt32, len(KINDS)) for _ in range(3))

    def add_call(self, kind, active):
        """Count a call's queries and packets."""
        dr.scatter_add(self.queries, mi.UInt32(1), kind, active)
        packet = dr.arange(mi.UInt32, max(dr.width(kind), dr.width(active))) // self.width
        packets = dr.width(packet) // self.width + 1
        # Written to memory, since Dr.Jit lets loops and conditions around this call mask that, too
        asked = dr.zeros(mi.UInt32, packets * len(KINDS))
        dr.scatter(asked, mi.UInt32(1), dr.fma(kind, packets, packet), active)
        self.packets += dr.block_reduce(dr.ReduceOp.Add, asked, packets)
        dr.eval(self.packets, self.queries)

    def each(self, paths):
        """{what: {kind: number for each of so many paths}}; packets as if all lanes were busy."""
        return {
            what: {kind: x / paths for kind, x in zip(KINDS, values)}
            for what, values in (
                ("rays", self.rays),
                ("queries", self.queries),
                ("packets", self.packets * self.width),
            )
        }


class CountedScene:
    """A scene that counts what is asked of it for rays of a kind (an index into ``KINDS``)."""

    def __init__(self, scene, counts, kind):
        self.scene, self.counts, self.kind = scene, counts, kind

    def __getattr__(self, name):
        return getattr(self.scene, name)

    def _counted(self, query, ray, *arguments, **named):
        active = named.get("active", arguments[-1] if arguments else True)
        self.counts.add_call(self.kind, mi.Bool(active))
        return query(ray, *arguments, **named)

    def ray_intersect_preliminary(self, ray, *arguments, **named):
        return self._counted(self.scene.ray_intersect_preliminary, ray, *arguments, **named)

    def ray_intersect(self, ray, *arguments, **named):
        return self._counted(self.scene.ray_intersect, ray, *arguments, **named)

    def ray_test(self, ray, *arguments, **named):
        return self._counted(self.scene.ray_test, ray, *arguments, **named)


@contextlib.contextmanager
def counting():
    """Count what all tracers do; gives the ``Counts``."""
    from nil_mitsuba.tracer import Tracer

    counts = Counts()
    intersect = Tracer.intersect
    # An earlier commit has no obstacles
    names = [name for name in ("occluded", "obstacle") if hasattr(Tracer, name)]
    towards_lights = {name: getattr(Tracer, name) for name in names}

    def watched(trace, tracer, p, kind, active):
        scene = tracer.scene
        kind += dr.zeros(mi.UInt32, dr.width(p))  # one for each ray
        dr.scatter_add(counts.rays, mi.UInt32(1), kind, active)
        tracer.scene = CountedScene(scene, counts, kind)
        try:
            return trace()
        finally:
            tracer.scene = scene

    def counted_intersect(tracer, p, v, cone, reach, active, *time, **ends):
        def trace():
            return intersect(tracer, p, v, cone, reach, active, *time, **ends)

        kind = dr.select(cone.soft, mi.UInt32(KINDS.index("soft")), KINDS.index("seen"))
        return watched(trace, tracer, p, kind, active & (reach > 0))

    def counted(shadow):
        def counted_shadow(tracer, p, start, v, cone, reach, active, *time):
            def trace():
                return shadow(tracer, p, start, v, cone, reach, active, *time)

            kind = mi.UInt32(KINDS.index("shadow"))
            return watched(trace, tracer, p, kind, active & (reach > 0))

        return counted_shadow

    Tracer.intersect = counted_intersect
    for name, shadow in towards_lights.items():
        setattr(Tracer, name, counted(shadow))
    try:
        # Step by step, so that the lanes of a packet can be looked at together
        with (
            dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False),
            dr.scoped_set_flag(dr.JitFlag.SymbolicConditionals, False),
        ):
            yield counts
    finally:
        Tracer.intersect = intersect
        for name, shadow in towards_lights.items():
            setattr(Tracer, name, shadow)
