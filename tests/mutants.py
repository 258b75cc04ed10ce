"""Checks the tests: breaks the package in one place at a time and reports which of these mutants the tests kill.

Every mutant is a mistake that an engineer could make: a wrong sign, a factor of two, a dropped term. The script copies
the package to a temporary folder, replaces one piece of text and runs the tests that should notice. A mutant is killed
if a test fails, the tests cannot be collected, they crash, or they exceed the time limit. A mutant whose text does not
occur exactly once in the package is reported as lost and has to be adapted to the code; it does not count as killed.

    python tests/mutants.py --jobs 2
    python tests/mutants.py --only "hot loop" multigrid

Pytest does not collect this file. The exit code is 0 only if every mutant was killed.
"""

import argparse
import concurrent.futures
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
TIME_LIMIT = 300

# Added to the tests' configuration: a failure is all that counts, so hypothesis need not look for the simplest one.
NO_SHRINKING = """
import hypothesis as _hypothesis
_phases = [_hypothesis.Phase.explicit, _hypothesis.Phase.generate]
_hypothesis.settings.register_profile("mutants", phases=_phases, derandomize=True, database=None)
_hypothesis.settings.load_profile("mutants")
"""


class Mutant(NamedTuple):
    """One mistake.

    Attributes:
        name: what is broken.
        place: function or class that holds the text.
        source: text to replace, which occurs once in the package; any white space matches any other.
        replacement: text that takes its place.
        tests: arguments of pytest, relative to the folder of the tests.
    """

    name: str
    place: str
    source: str
    replacement: str
    tests: str


# fmt: off
MUTANTS = [
    # Tables and the hot loop.
    Mutant("hot loop: adds the centre", "_row_sums",
           "block.indices[slot]) - centre", "block.indices[slot]) + centre", "test_tables.py -k weighted_sum"),
    Mutant("hot loop: long rows add the centre", "_row_sums",
           "(block.neighbours(u) - centre[None]), axis=0)", "(block.neighbours(u) + centre[None]), axis=0)",
           "test_contraction.py -k thousand"),
    Mutant("reverse pass: sign of the imbalance", "_form",
           "transposed + _over_species(", "transposed - _over_species(", "test_contraction.py -k dense"),
    Mutant("reverse weights: a row's own sum is left out", "reverse_weights",
           "slot_sum(table.reverse.users, slots) - used", "slot_sum(table.reverse.users, slots)",
           "test_contraction.py -k dense"),
    Mutant("reverse pass: other weights keep the old reverse", "_filled",
           'operands._replace(reverse=None) if "weights" in (name, open_) else operands', "operands",
           "test_contraction.py -k dense"),
    Mutant("differences: neighbours without the centre", "_products",
           "(take(u, neighbours) - centre)", "take(u, neighbours)", "test_contraction.py -k differences"),
    Mutant("table: full rows are dropped", "_slots",
           "lengths[own] <= width", "lengths[own] < width", "test_tables.py -k holds"),
    Mutant("sparse matrix: sign of the diagonal", "difference_matrix",
           "neighbours - scipy.sparse.diags_array", "neighbours + scipy.sparse.diags_array",
           "test_backend.py -k matrix"),
    # Lifting.
    Mutant("paper weights: sign of the second corner", "gradient_weights",
           "[-a[..., 1], a[..., 0]]", "[a[..., 1], -a[..., 0]]", "test_paper.py -k formulas"),
    Mutant("paper weights: distance of the centroid in place of its square", "gradient_weights",
           "xp.where(has_face, squared_centroid, 1)", "xp.where(has_face, squared_centroid**0.5, 1)",
           "test_paper.py -k formulas"),
    Mutant("ring: the fan of a boundary vertex is closed", "RingTopology.following",
           "xp.where(self.is_boundary[None], slot, 0)", "xp.where(self.is_boundary[None], 0, 0)",
           "test_curvature.py -k 'bonnet and disk'"),
    Mutant("intrinsic transport: edges do not turn half around", "edge_turn",
           "+ np.pi - take(directions.angles, half_edges ^ 1)", "- take(directions.angles, half_edges ^ 1)",
           "test_intrinsic.py -k parallel"),
    Mutant("intrinsic angles: cones are not flattened", "directions",
           "2 * np.pi / xp.where(inside, angles.sums, 1)", "xp.ones_like(angles.sums)",
           "test_vectors.py -k pointwise"),
    Mutant("flips: sign of a new angle", "flip",
           "cy * down - cx * along", "cy * down + cx * along", "test_intrinsic.py -k bending"),
    Mutant("flips: length of the new diagonal", "flip",
           "along, down = dx - cx, cy + dy", "along, down = dx - cx, cy - dy", "test_intrinsic.py -k bending"),
    Mutant("cotangents: of another corner", "cotangent_weights",
           "b**2 + c**2 - own**2) / xp.where(has_area", "b**2 - c**2 + own**2) / xp.where(has_area",
           "test_intrinsic.py -k cotangent"),
    Mutant("cotangents: dual area twice as large", "cotangent_weights",
           "xp.sum(w * own**2, axis=0) / 4", "xp.sum(w * own**2, axis=0) / 2", "test_intrinsic.py -k cotangent"),
    Mutant("frames: sign of their turn", "aligned_frames",
           "y * xp.cos(theta) - x * xp.sin(theta)", "y * xp.cos(theta) + x * xp.sin(theta)",
           "test_intrinsic.py -k crease"),
    Mutant("corners: direction of the second side", "boundary_conormals",
           "take(directions.angle_sums, boundary) - np.pi / 2", "take(directions.angle_sums, boundary) + np.pi / 2",
           "test_boundary.py -k corners"),
    Mutant("boundary frames: spacings exchanged", "boundary_frames",
           "to_next * previous_squared - to_previous * next_squared",
           "to_next * next_squared - to_previous * previous_squared", "test_boundary.py -k uneven"),
    Mutant("flux weights: factor two", "flux_weights",
           "-m[:, 1:] / 2", "-m[:, 1:]", "test_boundary.py -k flux"),
    Mutant("boundary rows: normal moment is required", "conditions",
           "xp.where(kinds >= SMOOTH, 0, y)", "xp.where(kinds > SMOOTH, 0, y)", "test_boundary.py -k neumann"),
    Mutant("corner rows: right corners keep the sum alone", "conditions",
           "kinds == OTHER_CORNER", "kinds >= RIGHT_CORNER", "test_boundary.py -k right_corners"),
    Mutant("jets: scale of the ring is not squared", "operator_weights",
           "c / scale[None, None] ** 2", "c / scale[None, None]", "test_monotone.py -k plane"),
    Mutant("jets: second derivatives are not covariant", "covariant",
           "weights[2:] - height[2:, None] * along[None]", "weights[2:]", "test_polynomial.py -k jets"),
    Mutant("vertex areas: half of each face", "_vertex_areas",
           "squared, 1)), 0), axis=0) / 6", "squared, 1)), 0), axis=0) / 4", "test_conservation.py -k quadrature"),
    # Operators.
    Mutant("gradient: axes of the frame exchanged", "gradient",
           'jnp.einsum("av...,vac->v...c", components', 'jnp.einsum("av...,vac->v...c", components[::-1]',
           "test_monotone.py -k plane"),
    Mutant("divergence: sign of the second component", "divergence",
           "along_x(components[0]) + along_y(", "along_x(components[0]) - along_y(", "test_paper.py -k formulas"),
    Mutant("divergence: neighbours turn the wrong way", "weigh_in_frames",
           "wx * turn[..., 0] + wy * turn[..., 1]", "wx * turn[..., 0] - wy * turn[..., 1]",
           "test_paper.py -k formulas"),
    Mutant("hessian: components exchanged", "Surface.hessian_stencils",
           "xx, xy, yy = (Stencil(", "xx, yy, xy = (Stencil(", "test_polynomial.py -k jets"),
    Mutant("harmonic mean: factor two", "_harmonic",
           "2 * (first / total) * second", "(first / total) * second", "test_spreads.py -k constant"),
    Mutant("arithmetic mean: conductivity of the neighbour", "Stencil.with_conductivity",
           "block.centre(g)[None] + rise / 2", "block.centre(g)[None] + rise", "test_elliptic.py -k weighted"),
    Mutant("flux: sign", "add_flux",
           ".at[surface.topology.boundary].add(added", ".at[surface.topology.boundary].add(-added",
           "test_boundary.py -k flux"),
    Mutant("integrate: the measure is ignored", "integrate",
           "surface.vertex_areas if measure is None else measure", "surface.vertex_areas",
           "test_conservation.py -k mass"),
    Mutant("spectral bound: factor two", "Stencil.spectral_bound",
           "2 * jnp.max(sizes) + (0 if", "jnp.max(sizes) + (0 if", "test_spreads.py -k bound"),
    Mutant("stencil: half of the mixed derivative", "operator_targets",
           "2 * xy, 2 * xx, 2 * yy])[None]", "xy, 2 * xx, 2 * yy])[None]", "test_elliptic.py -k anisotropic"),
    # Curvature.
    Mutant("curvature: sign of the mixed term of Gauss", "_curvature",
           "xx * yy - xy**2", "xx * yy + xy**2", "test_polynomial.py -k curvature"),
    Mutant("curvature: sign", "_bending_of_heights",
           "return -height_jet(", "return height_jet(", "test_curvature.py -k fitted"),
    Mutant("curvature: principal directions turned the wrong way", "_curvature",
           "jnp.stack([cosine, sine], axis=-1), jnp.stack([-sine, cosine], axis=-1)",
           "jnp.stack([cosine, -sine], axis=-1), jnp.stack([sine, cosine], axis=-1)",
           "test_polynomial.py -k cylinder"),
    Mutant("polyhedral curvature: mean twice as large", "polyhedral_curvature",
           "length * angle / 4", "length * angle / 2", "test_curvature.py -k mean"),
    Mutant("polyhedral curvature: defects on the boundary", "polyhedral_curvature",
           "jnp.where(is_boundary, 0, 2 * jnp.pi - total)", "(2 * jnp.pi - total)", "test_curvature.py -k bonnet"),
    # Tangent fields.
    Mutant("transport: the wrong axis", "transport",
           "_NEARLY_OPPOSITE) * (source + target)", "_NEARLY_OPPOSITE) * (source - target)",
           "test_vector_diffusion.py -k holonomy"),
    Mutant("curl: sign", "curl",
           "return -divergence(surface, rotated(", "return divergence(surface, rotated(", "test_vectors.py -k curl"),
    Mutant("vector Laplacian: sign of the turned part", "Connection",
           "cosine[..., 0] - sine[..., 1]", "cosine[..., 0] + sine[..., 1]", "test_vectors.py -k killing"),
    Mutant("Hodge Laplacian: sign of the curvature", "_hodge_laplacian",
           "vector_laplacian(surface, X) - _broadcast(", "vector_laplacian(surface, X) + _broadcast(",
           "test_vectors.py -k hodge"),
    Mutant("tensor Laplacian: lines are transported as vectors", "tensor_laplacian",
           "connection(surface, 2)(", "connection(surface, 1)(", "test_vectors.py -k tensors"),
    Mutant("Lie bracket: sign", "lie_bracket",
           'along - jnp.einsum("vcd,vd->vc"', 'along + jnp.einsum("vcd,vd->vc"', "test_vectors.py -k bracket"),
    Mutant("singularities: curvature of the face left out", "singularities",
           "jnp.sum(turning, axis=1) + symmetry * holonomy", "jnp.sum(turning, axis=1)",
           "test_vector_diffusion.py -k euler"),
    Mutant("harmonic fields: sign of the curvature", "_harmonic",
           "-connection_matrix(surface) + scipy.sparse.diags_array(",
           "-connection_matrix(surface) - scipy.sparse.diags_array(", "test_vector_diffusion.py -k torus"),
    # Equations.
    Mutant("Robin: sign of the value", "fluxes",
           "(g - a * u) / b", "(g + a * u) / b", "test_linear_systems.py -k poisson_on_a_disk"),
    Mutant("Dirichlet: the rate of a moving value is zero", "held_rate",
           "surface, change, rate)", "surface, jnp.zeros_like(change), rate)", "test_boundary.py -k rate_at_held"),
    Mutant("conditions: a predicate reaches inside", "_mask",
           "mask & on_boundary if callable(where) else mask", "mask", "test_boundary.py -k specified"),
    Mutant("Cahn-Hilliard: sign of the linear term", "CahnHilliard.potential",
           "u**3 - u - jnp.asarray(self.width", "u**3 + u - jnp.asarray(self.width", "test_equations.py -k cahn"),
    Mutant("Cahn-Hilliard: width is not squared", "CahnHilliard.potential",
           "jnp.asarray(self.width, u.dtype) ** 2 * laplacian(", "jnp.asarray(self.width, u.dtype) * laplacian(",
           "test_equations.py -k linear"),
    Mutant("Gray-Scott: v is not fed away", "_gray_scott",
           '(p["feed"] + p["kill"]) * v', 'p["kill"] * v', "test_kinetics.py -k rates_"),
    Mutant("Barkley: sign of the threshold", "_barkley",
           '(v + p["b"]) / p["a"]', '(v - p["b"]) / p["a"]', "test_kinetics.py -k rates_"),
    Mutant("Ginzburg-Landau: sense of the rotation", "_ginzburg_landau",
           'square * (v + p["imaginary"] * u)', 'square * (v - p["imaginary"] * u)',
           "test_kinetics.py -k rates_"),
    Mutant("Brusselator: conversion without outflow", "_brusselator",
           '(p["b"] + 1) * u', 'p["b"] * u', "test_kinetics.py -k rates_"),
    Mutant("growing surface: sign of the dilution", "Moving.rate",
           "self.surface_at(t, surface), u) - self._diluted(t, surface, u)\n\n    def explicit_rate",
           "self.surface_at(t, surface), u) + self._diluted(t, surface, u)\n\n    def explicit_rate",
           "test_equations.py -k growing"),
    Mutant("reaction: left out of the spectral bound", "ReactionDiffusion.spectral_bound",
           "self.diffusion_bound(t, surface, u) + reaction", "self.diffusion_bound(t, surface, u)",
           "test_stability.py -k bound"),
    # Steppers.
    Mutant("Legendre stages: sign of the one before the last", "_family_of",
           "(1 - j) / j * b / before", "(j - 1) / j * b / before", "test_stability.py -k polynomial"),
    Mutant("Legendre stages: the rate at the start", "_family_of",
           "np.roll(b * value, 1, axis=1) - 1)", "np.roll(b * value, 1, axis=1) + 1)",
           "test_steppers.py -k 'order and RKL2'"),
    Mutant("RKL1: damped stages lose their consistency", "RKL1._family",
           "value[:, STAGES] / slope[:, STAGES]", "1 / slope[:, STAGES]", "test_stability.py -k polynomial"),
    Mutant("damping: stages reach twice as far", "_family_of",
           "reach = 2 * w0 / scale", "reach = 4 * w0 / scale", "test_stability.py -k polynomial"),
    Mutant("damping: parabola of undamped stages", "_family_of",
           "(1 - 1 / w0**2) * reach", "reach", "test_stability.py -k polynomial"),
    Mutant("stage count: steps twice as long as stable", "Stabilised.plan",
           "length * inverse <= 1", "length * inverse <= 2", "test_stability.py -k polynomial"),
    Mutant("stages: time of the next one", "Plan.time",
           "self.c[jnp.minimum(j, self.stages) - 1]", "self.c[jnp.minimum(j, self.stages)]",
           "test_steppers.py -k 'order and RKL2'"),
    Mutant("backward Euler: trapezoidal step", "BackwardEuler",
           "a=np.array([[0, 0], [0, 1.0]]), b=np.array([0, 1.0])",
           "a=np.array([[0, 0], [0.5, 0.5]]), b=np.array([0.5, 0.5])", "test_steppers.py -k 'order and BackwardEuler'"),
    Mutant("TRBDF2: weights of the second stage", "TRBDF2",
           "[_W, _W, _D]]", "[_D, _W, _D]]", "test_steppers.py -k 'order and TRBDF2'"),
    Mutant("TRBDF2: time of the second stage", "TRBDF2",
           "c=np.array([0, 2 * _D, 1.0])", "c=np.array([0, _D, 1.0])", "test_steppers.py -k 'order and TRBDF2'"),
    Mutant("SBDF2: ratio of the steps is not squared", "SBDF2.step",
           "ratio**2 / (1 + ratio)", "ratio / (1 + ratio)", "test_steppers.py -k linear_growth"),
    Mutant("SBDF2: reaction is not extrapolated", "SBDF2.step",
           "(1 + ratio) * mild - ratio * mild_before", "mild", "test_steppers.py -k 'order and SBDF2'"),
    Mutant("adaptive steps: absolute tolerance without the relative one", "AdvancingController",
           "self.relative_atol * magnitude", "magnitude", "test_solve.py -k tolerance"),
    Mutant("taped reverse pass: the rate at the start left out", "_transpose_stage",
           "ct.first_rate + plan.dt * gamma_rate *", "ct.first_rate + 0 * gamma_rate *", "test_taped.py -k shorter"),
    Mutant("taped reverse pass: increment before the last", "_transpose_stage",
           "nu * ct.last, first_rate", "nu * ct.before, first_rate", "test_taped.py -k shorter"),
    Mutant("restart: counts begin again", "_remaining_intervals",
           'int(count) + last["counts"].get(name, 0)', "int(count)", "test_restart.py -k intervals"),
    # Linear systems, eigenmodes and distances.
    Mutant("BiCGStab: sign of the search direction", "BiCGStab.iterate",
           "r + beta * (p - step * v)", "r + beta * (p + step * v)", "test_multigrid.py -k bicgstab_needs"),
    Mutant("CG: right-hand side without the preconditioner", "conjugate_gradients",
           "preconditioner.transposed(b) / size, {})", "b / size, {})", "test_denoising.py -k more_accurate"),
    Mutant("multigrid: sign of the second sweep", "Multigrid",
           "u + _DAMPING[1] * (r - apply(u)) / diagonal", "u - _DAMPING[1] * (r - apply(u)) / diagonal",
           "test_multigrid.py -k cycle"),
    Mutant("multigrid: restriction without the measure", "Multigrid",
           "residual if transposed else weights * residual", "residual", "test_multigrid.py -k cycle"),
    Mutant("Poisson: constants are not deflated", "stationary_diffusion",
           "jax.ops.segment_max) <= 0", "jax.ops.segment_max) < 0", "test_linear_systems.py -k with_a_mean"),
    Mutant("eigenmodes: modes found before are not deflated", "_DeflatedInverse",
           "- right @ (self.inverse * (left.T @ v))", "", "test_modes.py -k multiplet"),
    Mutant("distance: sides of the unfolded triangle exchanged", "_apex",
           "first**2 - second**2 + length**2", "second**2 - first**2 + length**2", "test_distance.py -k plane"),
    Mutant("distance: corners cast no shadow", "_from_own_origins",
           "pairs.beyond + np.abs(origin - pairs.places[::-1])", "np.full(origin.shape, np.inf)",
           "test_distance.py -k bend"),
    # Mesh files and checks.
    Mutant("OBJ: indices begin at zero", "parse_obj",
           "corners += [index - 1 if", "corners += [index if", "test_mesh_files.py -k obj_with"),
    Mutant("OBJ: relative indices one too far", "parse_obj",
           "latest + index for index in indices", "latest + index + 1 for index in indices",
           "test_mesh_files.py -k obj_with"),
    Mutant("PLY: big-endian files read as little-endian", "parse_ply",
           '"binary_big_endian": ">"', '"binary_big_endian": "<"', "test_mesh_files.py -k binary"),
    Mutant("PLY: other triangles of a strip are turned", "_strip_triangles",
           "% 2 == 1\n    triples", "% 2 == 0\n    triples", "test_mesh_files.py -k programs"),
    Mutant("OFF: colours always have four numbers", "_off_rows",
           '((4, 3) if "C" in head', '((4,) if "C" in head', "test_mesh_files.py -k line_breaks"),
    Mutant("welding: one equal coordinate is enough", "welded_vertices",
           "np.any(positions[order[1:]] !=", "np.all(positions[order[1:]] !=", "test_mesh_files.py -k stl"),
    Mutant("orientation: closed surfaces face in", "reversed_faces",
           "component, is_reversed) < 0)", "component, is_reversed) > 0)", "test_mesh_checks.py -k orientation"),
    Mutant("orientation: volume about the origin", "_volumes",
           "corners - centre[component, None]", "corners", "test_mesh_checks.py -k origin"),
    Mutant("non-manifold: three faces at an edge pass", "check_edges",
           "in_order[2:] == in_order[:-2]", "in_order[3:] == in_order[:-3]", "test_mesh_checks.py -k three_faces"),
    Mutant("glTF: mirrored parts are not turned over", "_scene",
           "np.linalg.det(matrix[:3, :3]) < 0", "np.linalg.det(matrix[:3, :3]) < -9e9", "test_mesh_files.py -k scene"),
    # Saved fields.
    Mutant("saving: colours of a glTF file stay in sRGB", "write_glb",
           '"COLOR_0": np.concatenate([linear,', '"COLOR_0": np.concatenate([srgb,', "test_textures.py -k glb"),
    Mutant("saving: texture upside down", "bake",
           "uv * [size, -size] + [-0.5, size - 0.5]", "uv * [size, size] + [-0.5, -0.5]",
           "test_textures.py -k exactly"),
    Mutant("loading: series without times", "_pvd",
           "series | ({} if np.isnan(times).any() else dict(times=times))", "series",
           "test_saved_fields.py -k times"),
    # Fits.
    Mutant("fit: covariance of the free numbers", "evidence",
           "slopes[:, None] * errors.covariance * slopes", "errors.covariance", "test_fit_evidence.py -k transform"),
    Mutant("fit: degrees of freedom without the unknowns", "evidence",
           "data.num_values - float(np.sum(leverages))", "float(data.num_values)", "test_fit_evidence.py -k noise"),
    Mutant("bounded parameters: sign of the inverse", "Bounded.free",
           "jnp.log(share) - jnp.log1p(-share)", "jnp.log(share) + jnp.log1p(-share)", "test_fit_search.py -k keeps"),
    Mutant("Huber loss: jump at its scale", "_huber",
           "2 * jnp.sqrt(jnp.maximum(z, 1)) - 1", "2 * jnp.sqrt(jnp.maximum(z, 1))", "test_real_data.py -k scipy"),
    Mutant("soft loss: half of it", "_soft_l1",
           "2 * z / (1 + jnp.sqrt(1 + z))", "z / (1 + jnp.sqrt(1 + z))", "test_real_data.py -k scipy"),
    Mutant("chi square: over the values, not the degrees of freedom", "agreement",
           "np.where(counted, misfit, 0) ** 2) / free", "np.where(counted, misfit, 0) ** 2) / size",
           "test_fit_evidence.py -k reduced_chi_square"),
    Mutant("deviance: factor two", "root_of_deviance",
           "2 * (far - jnp.log1p(far)) / far**2", "(far - jnp.log1p(far)) / far**2", "test_real_data.py -k deviance"),
    Mutant("calibration: sign of the offset", "Calibration",
           "measured + full(offset)", "measured - full(offset)", "test_real_data.py -k offset"),
    Mutant("masks: values that were not measured count", "Observations.misfit",
           "jnp.where(self.mask, (predicted - self.values) / (noise * spread), 0)",
           "(predicted - self.values) / (noise * spread)", "test_real_data.py -k no_misfit"),
    # Imaging.
    Mutant("total variation: sign of the oblique side", "HatGradients.from_surface",
           "-x / (length * y)", "x / (length * y)", "test_denoising.py -k linear_fields"),
    Mutant("total variation: faces twice as large", "HatGradients.from_surface",
           "jnp.where(is_flat, 0, length * y / 2)", "jnp.where(is_flat, 0, length * y)", "test_denoising.py -k grid"),
    Mutant("line integral convolution: both halves go forward", "_convolved",
           "jnp.asarray([1.0, -1.0], weights.dtype)", "jnp.asarray([1.0, 1.0], weights.dtype)",
           "test_streamlines.py -k circles"),
    Mutant("fairing: sign of the second order", "_implicit_step",
           "strength * laplacian(surface, jnp.where(is_held", "-strength * laplacian(surface, jnp.where(is_held",
           "test_graphics.py -k fairing_divides"),
    Mutant("PSNR: decibels of amplitudes", "psnr",
           "10 * jnp.log10(_peak", "20 * jnp.log10(_peak", "test_imaging.py -k quality"),
    # Formulas and scenarios.
    Mutant("formulas: a chain is computed from its end", "_Parser.binary",
           "for operation in reversed(operations):", "for operation in operations:", "test_formulas.py -k bind"),
    Mutant("formulas: exponents lose their fraction", "_Parser.binary",
           "<= _LARGEST_POWER and exponent == int(exponent)", "<= _LARGEST_POWER",
           "test_formulas.py -k bind"),
    Mutant("scenarios: diffusivities grow with the length", "read_equation",
           'scale**2 * overrides.get(f"diffusivity', 'scale * overrides.get(f"diffusivity',
           "test_scenarios.py -k scale"),
    Mutant("scenarios: unit area without the root", "read_mesh",
           "math.sqrt(4 * math.pi / mesh.area)", "(4 * math.pi / mesh.area)", "test_scenarios.py -k area"),
]
# fmt: on


class Outcome(NamedTuple):
    """What came of a mutant: "killed", or why it was not; the test that killed it; seconds."""

    status: str
    detail: str
    seconds: float


def sources(package: Path, text: str) -> list[tuple[Path, re.Match[str]]]:
    """Every place in the package where the text occurs; white space matches any white space."""
    pattern = re.compile(r"\s+".join(map(re.escape, text.split())))
    files = sorted(package.rglob("*.py"))
    return [(path, match) for path in files for match in pattern.finditer(path.read_text(encoding="utf-8"))]


def copy_project(folder: Path) -> Path:
    """Copies the package and its tests into a folder, beside a link to the shared meshes if there are any."""
    copy = folder / "copy"
    for name in ("ltljax", "tests"):
        shutil.copytree(ROOT / name, copy / name)
    shutil.copy(ROOT / "pyproject.toml", copy)
    with open(copy / "tests" / "conftest.py", "a", encoding="utf-8") as file:
        file.write(NO_SHRINKING)
    shared = ROOT.parent / "shared"
    if shared.exists():
        (folder / "shared").symlink_to(shared.resolve())
    return copy


def run_tests(copy: Path, arguments: str) -> tuple[str, str]:
    """Runs the tests in a copy; returns the status and the test that failed."""
    paths = [f"tests/{word}" if word.endswith(".py") else word for word in shlex.split(arguments)]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--tb=no", *paths]
    search_path = os.pathsep.join(filter(None, [str(copy), os.environ.get("PYTHONPATH")]))
    try:
        process = subprocess.run(
            command, cwd=copy, env=os.environ | {"PYTHONPATH": search_path}, timeout=TIME_LIMIT,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "killed", "time limit"
    failure = re.search(r"^(?:FAILED|ERROR) (?:tests/)?(.*?)(?: - .*)?$", process.stdout, re.MULTILINE)
    if process.returncode < 0:
        return "killed", f"crash (signal {-process.returncode})"
    if failure and process.returncode in (1, 2):
        return "killed", failure.group(1)
    return {0: "survived", 5: "no tests"}.get(process.returncode, f"exit code {process.returncode}"), arguments


def judge(mutant: Mutant, is_unmutated: bool) -> Outcome:
    """Applies a mutant to a copy of the project and runs its tests."""
    begin = time.perf_counter()
    places = sources(ROOT / "ltljax", mutant.source)
    if len(places) != 1:
        return Outcome("lost", f"the text of {mutant.place} occurs {len(places)} times", 0.0)
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        copy = copy_project(Path(folder))
        if not is_unmutated:
            path, match = places[0]
            text = path.read_text(encoding="utf-8")
            target = copy / path.relative_to(ROOT)
            target.write_text(text[: match.start()] + mutant.replacement + text[match.end() :], encoding="utf-8")
        status, detail = run_tests(copy, mutant.tests)
    return Outcome(status, detail, time.perf_counter() - begin)


def row(mutant: Mutant, outcome: Outcome) -> str:
    """One row of the table."""
    result = outcome.detail if outcome.status == "killed" else f"**{outcome.status}**: {outcome.detail}"
    return f"| {mutant.name} | {result.replace('|', '/')} | {outcome.seconds:.0f} |"


def main() -> int:
    """Runs the mutants and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="mutants at a time (default: 1)")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only mutants whose names contain one of these texts")
    parser.add_argument("--output", type=Path, metavar="FILE", help="a Markdown file to write the table to as well")
    parser.add_argument("--unmutated", action="store_true", help="run the same tests on the unchanged package, "
                        "which must all survive")  # fmt: skip
    options = parser.parse_args()
    chosen = [m for m in MUTANTS if options.only is None or any(text in m.name for text in options.only)]
    if not chosen:
        parser.error("no mutant has such a name")
    lines = ["| mutant | killed by | seconds |", "| --- | --- | ---: |"]
    print(*lines, sep="\n", flush=True)
    outcomes = []
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        for mutant, outcome in zip(chosen, pool.map(lambda m: judge(m, options.unmutated), chosen), strict=True):
            outcomes.append(outcome)
            lines.append(row(mutant, outcome))
            print(lines[-1], flush=True)
    killed = sum(outcome.status == "killed" for outcome in outcomes)
    lines += ["", f"{killed}/{len(chosen)} killed in {sum(outcome.seconds for outcome in outcomes):.0f} s"]
    print(*lines[-2:], sep="\n")
    if options.output is not None:
        options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if options.unmutated:
        return int(any(outcome.status != "survived" for outcome in outcomes))
    return int(killed < len(chosen))


if __name__ == "__main__":
    sys.exit(main())
