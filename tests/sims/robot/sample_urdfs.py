"""Builders of minimal URDF texts with selected elements."""

SOLID = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'


def link(name, mass=1.0, inertia=SOLID, shape=""):
    """Return a link; without a mass it states no inertial."""
    stated = "" if mass is None else f'<inertial><mass value="{mass}"/>{inertia}</inertial>'
    return f'<link name="{name}">{stated}{shape}</link>'


def joint(name, parent, child, kind="revolute", inside='<limit lower="-1" upper="1"/>'):
    """Return a joint about x."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="1 0 0"/>{inside}</joint>'
    )


def robot(*parts):
    return f'<robot name="r">{"".join(parts)}</robot>'


def one(inside='<limit lower="-1" upper="1"/>', kind="revolute", **of_link):
    """Return a link on a joint ``j`` on a base without mass."""
    return robot(
        link("base", None), link("arm", **of_link), joint("j", "base", "arm", kind, inside)
    )


def ball(size, at=(0, 0, 0)):
    """Return a spherical collision shape of a link."""
    return (
        f'<collision><origin xyz="{at[0]} {at[1]} {at[2]}"/>'
        f'<geometry><sphere radius="{size}"/></geometry></collision>'
    )


def mesh(file):
    return f'<collision><geometry><mesh filename="{file}"/></geometry></collision>'


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
"""A tetrahedron as an OBJ file."""
