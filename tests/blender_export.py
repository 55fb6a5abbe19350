"""A scene as Blender's exporter "mitsuba-blender" writes its own: made up here, laid out as there.

Blender's z is Mitsuba's y; one binary PLY file for each mesh, in world coordinates, lies in
"meshes", pictures lie in "textures"; materials are "principled" within "twosided"; objects that
repeat are instances of a shape group; the camera is turned about x, y and z and then moved, with
Blender's clipping distances.
"""

import math

import drjit as dr
import mitsuba as mi

SCENE = """<scene version="3.6.4">

<!-- Defaults, these can be set via the command line: -Darg=value -->

    <default name="spp" value="128"/>
    <default name="resx" value="1920"/>
    <default name="resy" value="1080"/>

<!-- Camera and Rendering Parameters -->

    <integrator type="path" id="elm__0" name="elm__0">
        <integer name="max_depth" value="12"/>
    </integrator>
    <sensor type="perspective" id="Camera" name="Camera">
        <string name="fov_axis" value="x"/>
        <float name="fov" value="39.597752"/>
        <float name="principal_point_offset_x" value="0.000000"/>
        <float name="principal_point_offset_y" value="-0.000000"/>
        <float name="near_clip" value="0.100000"/>
        <float name="far_clip" value="1000.000000"/>
        <transform name="to_world">
            <rotate x="1" angle="-152.901594"/>
            <rotate y="1" angle="-46.688340"/>
            <rotate z="1" angle="179.096140"/>
            <translate value="7.358891 4.958309 6.925791"/>
        </transform>
        <sampler type="independent" name="sampler">
            <integer name="sample_count" value="$spp"/>
        </sampler>
        <film type="hdrfilm" name="film">
            <integer name="width" value="$resx"/>
            <integer name="height" value="$resy"/>
            <string name="pixel_format" value="rgb"/>
            <rfilter type="gaussian" name="rfilter">
                <float name="stddev" value="1.500000"/>
            </rfilter>
        </film>
    </sensor>

<!-- Materials -->

    <bsdf type="twosided" id="mat-Ground" name="mat-Ground">
        <bsdf type="principled" name="bsdf">
            <texture type="bitmap" name="base_color">
                <string name="filename" value="textures/tiles.png"/>
                <string name="filter_type" value="bilinear"/>
                <string name="wrap_mode" value="repeat"/>
                <boolean name="raw" value="false"/>
            </texture>
            <float name="roughness" value="0.800000"/>
            <float name="specular" value="0.500000"/>
        </bsdf>
    </bsdf>
    <bsdf type="twosided" id="mat-Clay" name="mat-Clay">
        <bsdf type="principled" name="bsdf">
            <rgb name="base_color" value="0.700000 0.120000 0.060000"/>
            <float name="roughness" value="0.400000"/>
            <float name="clearcoat" value="0.300000"/>
        </bsdf>
    </bsdf>
    <bsdf type="twosided" id="default-bsdf" name="default-bsdf">
        <bsdf type="diffuse" name="bsdf"/>
    </bsdf>

<!-- Emitters -->

    <emitter type="envmap" id="World" name="World">
        <float name="scale" value="1.000000"/>
        <string name="filename" value="textures/sky.exr"/>
        <transform name="to_world">
            <matrix value="0 0 1 0 0 1 0 0 -1 0 0 0 0 0 0 1"/>
        </transform>
    </emitter>
    <shape type="rectangle" id="Area" name="Area">
        <transform name="to_world">
            <rotate x="1" angle="90"/>
            <translate value="-2.000000 5.000000 2.000000"/>
        </transform>
        <emitter type="area" name="emitter">
            <rgb name="radiance" value="20.000000 18.000000 15.000000"/>
        </emitter>
    </shape>

<!-- Shapes -->

    <shape type="ply" id="mesh-Plane" name="mesh-Plane">
        <string name="filename" value="meshes/Plane.ply"/>
        <boolean name="face_normals" value="true"/>
        <ref id="mat-Ground" name="bsdf"/>
    </shape>
    <shape type="ply" id="mesh-Torus" name="mesh-Torus">
        <string name="filename" value="meshes/Torus.ply"/>
        <ref id="mat-Clay" name="bsdf"/>
    </shape>
    <shape type="ply" id="mesh-Sphere" name="mesh-Sphere">
        <string name="filename" value="meshes/Sphere.ply"/>
        <ref id="mat-Ground" name="bsdf"/>
    </shape>
    <shape type="shapegroup" id="mesh-Cone" name="mesh-Cone">
        <shape type="ply" name="Cone">
            <string name="filename" value="meshes/Cone.ply"/>
            <ref id="default-bsdf" name="bsdf"/>
        </shape>
    </shape>
    {instances}
</scene>
"""
INSTANCE = """
    <shape type="instance" name="elm__{i}">
        <ref id="mesh-Cone" name="shape"/>
        <transform name="to_world">
            <matrix value="0.5 0 0 {x} 0 0.5 0 0 0 0 0.5 -3 0 0 0 1"/>
        </transform>
    </shape>"""


def export(folder):
    """Write the scene with its meshes and textures; the path of its XML file.

    A tiled ground of 12 units, on it a torus in the middle, a ball behind it and a row of five
    cones; an area light above, a sky around.
    """
    (folder / "meshes").mkdir()
    (folder / "textures").mkdir()
    _mesh(folder / "meshes/Plane.ply", 1, 1, lambda u, v: (12 * u - 6, 0 * u, 6 - 12 * v))
    _mesh(folder / "meshes/Torus.ply", 48, 24, _torus)
    _mesh(folder / "meshes/Sphere.ply", 32, 16, _ball)
    _mesh(folder / "meshes/Cone.ply", 24, 1, _cone)

    column, row = dr.meshgrid(dr.arange(mi.UInt32, 64), dr.arange(mi.UInt32, 64))
    tile = mi.Float((column // 8 + row // 8) % 2)
    _picture(folder / "textures/tiles.png", tile * mi.Color3f(0.5, 0.5, 0.2) + 0.3, 64)
    column, row = dr.meshgrid(dr.arange(mi.Float, 32), dr.arange(mi.Float, 16))
    height = dr.maximum(dr.cos((row + 0.5) / 16 * dr.pi), 0)
    _picture(folder / "textures/sky.exr", mi.Color3f(0.5, 0.6, 0.7) + height * 0.3, 32)

    path = folder / "scene.xml"
    cones = "".join(INSTANCE.format(i=i, x=2 * i - 6) for i in range(1, 6))
    path.write_text(SCENE.format(instances=cones))
    return path


def _torus(u, v):
    (s, c), (h, r) = dr.sincos(dr.two_pi * u), dr.sincos(dr.two_pi * v)
    return (1.2 + 0.5 * r) * c, 0.5 + 0.5 * h, -(1.2 + 0.5 * r) * s


def _ball(u, v):
    (s, c), (r, h) = dr.sincos(dr.two_pi * u), dr.sincos(math.pi * (1 - v))
    return r * c - 3, h + 1, -r * s - 0.5


def _cone(u, v):
    s, c = dr.sincos(dr.two_pi * u)
    return (1 - v) * c, 3 * v, -(1 - v) * s


def _mesh(path, columns, rows, surface):
    """Write the surface (u, v) ↦ (x, y, z) over the unit square as a binary PLY file."""
    i, j = dr.meshgrid(dr.arange(mi.UInt32, columns + 1), dr.arange(mi.UInt32, rows + 1))
    u, v = mi.Float(i) / columns, mi.Float(j) / rows
    a, b = dr.meshgrid(dr.arange(mi.UInt32, columns), dr.arange(mi.UInt32, rows))
    corner, above = a + b * (columns + 1), columns + 1
    faces = mi.Vector3u(
        dr.concat((corner, corner + 1)),
        dr.concat((corner + 1, corner + above + 1)),
        dr.concat((corner + above, corner + above)),
    )
    mesh = mi.Mesh("", dr.width(u), dr.width(faces), has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = dr.ravel(mi.Point3f(*surface(u, v)))
    params["vertex_texcoords"] = dr.ravel(mi.Point2f(u, v))
    params["faces"] = dr.ravel(faces)
    params.update()
    mesh.write_ply(str(path))


def _picture(path, color, width):
    image = mi.Bitmap(
        mi.TensorXf(dr.ravel(mi.Color3f(color)), (dr.width(color) // width, width, 3))
    )
    if path.suffix == ".png":
        image = image.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)
    image.write(str(path))
