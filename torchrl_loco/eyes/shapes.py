"""Where rays meet shapes, in the shape's own frame, from outside: a camera within a shape sees through it.

Directions need not have length 1: distances are in lengths of the direction.
"""

import warp as wp

from torchrl_loco.sim.compiled.collision.kinds import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE

MISS = wp.constant(wp.float32(1.0e10))  # the distance of what is not met
TINY = wp.constant(wp.float32(1.0e-12))
PAST = wp.constant(wp.float32(1.0e-5))  # how far behind a triangle a ray goes on, for each metre: more than rounding


@wp.func
def to_plane(o: wp.vec3, d: wp.vec3, size: wp.vec3) -> float:
    """Half sizes of 0 have no end."""
    if d[2] >= 0.0 or o[2] <= 0.0:
        return MISS
    t = -o[2] / d[2]
    x, y = wp.abs(o[0] + t * d[0]), wp.abs(o[1] + t * d[1])
    inside = (size[0] <= 0.0 or x <= size[0]) and (size[1] <= 0.0 or y <= size[1])
    return wp.where(inside, t, MISS)


@wp.func
def to_sphere(o: wp.vec3, d: wp.vec3, radius: float) -> float:
    """By where the ray is nearest to the middle: b^2 - ac would lose digits from afar."""
    a = wp.max(wp.dot(d, d), TINY)
    middle = -wp.dot(o, d) / a
    aside = o + middle * d
    square = radius * radius - wp.dot(aside, aside)
    t = middle - wp.sqrt(wp.max(square, 0.0) / a)
    return wp.where(square >= 0.0 and t > 0.0, t, MISS)


@wp.func
def to_round(o: wp.vec3, d: wp.vec3, radius: float, half: float, capped: bool) -> float:
    """A cylinder along z, or a capsule: what meets it meets the cylinder without ends, and enters it by side or end."""
    a = wp.max(d[0] * d[0] + d[1] * d[1], TINY)
    middle = -(o[0] * d[0] + o[1] * d[1]) / a
    x, y = o[0] + middle * d[0], o[1] + middle * d[1]
    square = radius * radius - x * x - y * y
    if square < 0.0:
        return MISS
    t = middle - wp.sqrt(square / a)
    z = o[2] + t * d[2]
    if wp.abs(z) <= half:
        return wp.where(t > 0.0, t, MISS)
    end = wp.sign(z) * half
    if capped:
        return to_sphere(o - wp.vec3(0.0, 0.0, end), d, radius)
    t = (end - o[2]) / wp.where(wp.abs(d[2]) > TINY, d[2], TINY)
    u, v = o[0] + t * d[0], o[1] + t * d[1]
    return wp.where(t > 0.0 and u * u + v * v <= radius * radius, t, MISS)


@wp.func
def to_box(o: wp.vec3, d: wp.vec3, size: wp.vec3) -> float:
    first, last = float(-MISS), float(MISS)
    for i in range(3):
        step = wp.where(wp.abs(d[i]) > TINY, d[i], TINY)
        one, other = (-size[i] - o[i]) / step, (size[i] - o[i]) / step
        first, last = wp.max(first, wp.min(one, other)), wp.min(last, wp.max(one, other))
    return wp.where(first > 0.0 and first <= last, first, MISS)


@wp.func
def to_shape(kind: int, o: wp.vec3, d: wp.vec3, size: wp.vec3) -> float:
    """Returns the distance to a shape that has a formula."""
    if kind == CAPSULE:
        return to_round(o, d, size[0], size[1], True)
    if kind == SPHERE:
        return to_sphere(o, d, size[0])
    if kind == BOX:
        return to_box(o, d, size)
    if kind == PLANE:
        return to_plane(o, d, size)
    if kind == CYLINDER:
        return to_round(o, d, size[0], size[1], False)
    if kind == ELLIPSOID:
        return to_sphere(wp.cw_div(o, size), wp.cw_div(d, size), 1.0)
    return MISS


@wp.func
def to_mesh(mesh: wp.uint64, o: wp.vec3, d: wp.vec3, most: float):
    """Returns distance, normal and triangle; a miss is far away. A ray leaves a mesh that it begins in unhindered."""
    length, gone = wp.length(d), float(0.0)
    way = d / length
    met = wp.mesh_query_ray(mesh, o, way, most * length)
    while met.result and wp.dot(met.normal, way) > 0.0:
        gone += met.t + PAST * (1.0 + gone + wp.length(o))
        met = wp.mesh_query_ray(mesh, o + gone * way, way, most * length - gone)
    return wp.where(met.result, (gone + met.t) / length, MISS), met.normal, met.face


@wp.func
def normal_of(kind: int, p: wp.vec3, size: wp.vec3) -> wp.vec3:
    """Returns where such a shape faces at one of its points."""
    if kind == PLANE:
        return wp.vec3(0.0, 0.0, 1.0)
    if kind == CAPSULE:
        return wp.normalize(wp.vec3(p[0], p[1], p[2] - wp.clamp(p[2], -size[1], size[1])))
    if kind == CYLINDER:
        if size[1] - wp.abs(p[2]) < 1.0e-4 * size[1] and p[0] * p[0] + p[1] * p[1] < 0.9999 * size[0] * size[0]:
            return wp.vec3(0.0, 0.0, wp.sign(p[2]))
        return wp.normalize(wp.vec3(p[0], p[1], 0.0))
    if kind == ELLIPSOID:
        return wp.normalize(wp.cw_div(wp.cw_div(p, size), size))
    if kind == BOX:
        q = wp.cw_div(p, size)
        r = wp.vec3(wp.abs(q[0]), wp.abs(q[1]), wp.abs(q[2]))
        if r[0] >= r[1] and r[0] >= r[2]:
            return wp.vec3(wp.sign(q[0]), 0.0, 0.0)
        if r[1] >= r[2]:
            return wp.vec3(0.0, wp.sign(q[1]), 0.0)
        return wp.vec3(0.0, 0.0, wp.sign(q[2]))
    return wp.normalize(p)
