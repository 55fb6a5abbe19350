"""Chords go through the glued faces of the quotient's cell, whatever the cell's edges are."""

import drjit as dr
import pytest

from nil_mitsuba import geometry


@pytest.mark.parametrize(
    "twist, edges", [(1, (1, 1, 1)), (0, (1, 2, 3)), (1 / 4, (2, 2, 1)), (-1.5, (2, 1, 0.5))]
)
def test_what_leaves_a_box_comes_in_by_the_face_that_is_glued_to_it(rgb, monkeypatch, twist, edges):
    from nil_mitsuba.quotient import Space, exit_through_face, multiply_cells, through_face

    mi = rgb
    monkeypatch.setattr(Space, "EDGES", edges)
    space = Space(float(twist), True, [0, 0, 0], 1.0)
    A, B, C = edges

    def place(g):
        return mi.Point3f(mi.Float(g.x) * A, mi.Float(g.y) * B, mi.Float(g.z) * C)

    random = mi.PCG32(size=10_000)
    p = mi.Point3f(*(random.next_float32() * edge for edge in edges))
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(random.next_float32(), random.next_float32()))
    d *= 10
    cell = mi.Vector3i(*(mi.Int32(random.next_float32() * 7) - 3 for _ in range(3)))

    s, face = exit_through_face(p, d, space)
    assert dr.all((s < 1) & (dr.sum(dr.abs(face)) == 1))
    on_face, beyond = p + s * d, p + 2 * s * d
    inside, (moved,), there = through_face(on_face, [beyond], cell, face, space)
    assert dr.all(dr.all((inside >= 0) & (inside <= mi.Point3f(edges))))
    ahead = moved - inside
    glued = mi.Vector3f(d.x, d.y, d.z - twist * mi.Float(face.x) * A * d.y)
    assert dr.all(dr.norm(ahead - s * glued) < 1e-4)

    # Deck elements multiply as their points do, and bring what was carried back to where it was
    step = multiply_cells(geometry.inverse(cell, space.integer_twist), there, space)
    back = geometry.multiply(place(step), inside, twist)
    assert dr.all(dr.norm(back - on_face) < 1e-4)
    product = geometry.multiply(place(cell), place(step), twist)
    assert dr.all(dr.norm(product - place(there)) < 1e-4)
