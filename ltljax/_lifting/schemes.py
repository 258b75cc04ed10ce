"""The schemes a user chooses from: small records that name a method and hold its few settings."""

import dataclasses
from typing import ClassVar, Literal

from .ring import Lift

Transport = Literal["paper", "shortest"]


@dataclasses.dataclass(frozen=True)
class Paper:
    """The published method: averaged affine gradients on the one-ring, and a Laplacian that composes them.

    It follows Chen, Chi and Wu (arXiv 0907.1817) exactly and is accurate on regular meshes. Before you use it for
    diffusion, know its limits: its Laplacian does not converge pointwise on irregular meshes, does not see modes that
    alternate from row to row, and has eigenvalues with positive real part, so diffusion can grow. `Monotone` has none
    of these faults.
    """

    lift: ClassVar[Lift] = "projection"
    transport: ClassVar[Transport] = "paper"
    is_monotone: ClassVar[bool] = False


@dataclasses.dataclass(frozen=True)
class Monotone:
    """The default: a quadratic fit on the lifted ring, with neighbours chosen so that no Laplacian weight is negative.

    It takes the same two steps as the paper: lift the ring to the tangent plane, then differentiate scattered data
    there. Non-negative weights give diffusion a maximum principle, and no eigenvalue of the Laplacian has a positive
    real part. Solutions are second order in the mesh size; the pointwise Laplacian is first order on irregular meshes.
    If a vertex has no consistent non-negative row, its row is the cotangent row of the intrinsic Delaunay
    triangulation.

    Attributes:
        lift: how the ring is laid out in the plane. ``"intrinsic"`` unfolds it by its edge lengths, so bending the
            surface, even along a crease, changes nothing. ``"chord"`` projects the ring to the tangent plane and keeps
            the length of every edge; ``"projection"`` is the paper's lift. The last two are accurate only on smooth
            surfaces; of these, chord is the more accurate except for the lowest modes of spheres.
    """

    lift: Literal["intrinsic", "chord", "projection"] = "intrinsic"
    degree: ClassVar[int] = 2
    transport: ClassVar[Transport] = "shortest"
    is_monotone: ClassVar[bool] = True

    def __post_init__(self):
        if self.lift not in ("intrinsic", "chord", "projection"):
            raise ValueError(f'Expected lift="intrinsic", lift="chord" or lift="projection", found {self.lift!r}.')


@dataclasses.dataclass(frozen=True)
class Polynomial:
    """Polynomial fits of degree 3 or 4, for smooth solutions on good meshes.

    Each fit uses about twice as many neighbours as it needs. Normals, gradient and Hessian come from the same fit, and
    the Laplacian accounts for the metric of the fitted surface. Stationary solutions are of order 2 for degree 3 and of
    order 4 for degree 4.

    Degree 4 pays off if normals turn by less than a radian over the neighbours of a fit. For Poisson's equation on a
    jittered torus with radii 2 and 1, its error equals that of `Monotone` at 800 vertices, is 0.4 of it at 1,600 and a
    tenth at 6,300; on a torus with bumps it is 1.6 times that of `Monotone` even at 6,300. A `CoarseMeshWarning`
    reports coarser meshes. Degree 3 has twice the error of `Monotone` there at every size: it is meant for gradients
    and curvature.

    A fit that would cross a crease is made in the intrinsic chart of the vertex, which is exact if both sides are flat
    and first order if they are curved. Weights have both signs, so there is no maximum principle, and on bad meshes the
    Laplacian can have growing modes; `solve` checks for them before the first step.

    Attributes:
        degree: 3 or 4.
    """

    degree: int = 4
    lift: ClassVar[Lift] = "projection"
    transport: ClassVar[Transport] = "shortest"
    is_monotone: ClassVar[bool] = False

    def __post_init__(self):
        if self.degree not in (3, 4):
            raise ValueError(f"Expected degree 3 or 4, found {self.degree!r}. Degree 2 is ltl.Monotone().")


Scheme = Paper | Monotone | Polynomial
