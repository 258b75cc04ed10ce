"""How fast the sum over slots is, forward and in reverse, compared with alternatives: Markdown tables.

python benchmarks/speed.py [--sizes 10000 164000 655000 1000000] [--dtypes float32 float64] [--parts apply step ...]
python benchmarks/speed.py --device gpu

The contestants of a row take turns. Each figure is the median over rounds of the best of one to three calls. Compile
times are listed separately. All contestants use the same matrix. On a GPU, contestants that run on the host are
omitted, and the memory bandwidth of the Laplacian is compared with that of a copy. The extra `bench` installs the other
packages; missing ones are omitted.
"""

import argparse
import functools
import importlib
import importlib.util
import math
import os
import resource
import subprocess
import sys
import time
import warnings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")

import jax

jax.config.update("jax_enable_x64", True)

import jax.experimental.sparse as jsparse  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import scipy.sparse  # noqa: E402

import ltljax as ltl  # noqa: E402

# An icosphere if there is one of about the size, otherwise a torus.
SIZES = (10_000, 164_000, 655_000, 1_000_000)
SPECIES = (1, 2, 4)
PARTS = ("apply", "step", "reverse", "order", "build")
ROUNDS = 9
STEPS = 200
FEED, KILL, DIFFUSIVITY = 0.04, 0.06, (1.0, 0.5)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="approximate numbers of vertices")
    parser.add_argument("--dtypes", nargs="+", default=("float32", "float64"), choices=("float32", "float64"))
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS)
    parser.add_argument("--device", default="cpu", choices=("cpu", "gpu"))
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        return child(*arguments.child)
    jax.config.update("jax_default_device", jax.devices(arguments.device)[0])
    warnings.simplefilter("ignore")
    print(
        f"{jax.devices(arguments.device)[0]}, {os.cpu_count()} cores, jax {jax.__version__}, NumPy {np.__version__}\n"
    )
    for part in arguments.parts:
        if arguments.device == "gpu" and part == "build":
            continue
        TABLES[part](arguments)
        print(flush=True)
    return None


def compare(contestants, rounds=ROUNDS, inner=3):
    """Milliseconds of each contestant: the median over rounds of the best of ``inner`` calls."""
    for contestant in contestants.values():
        contestant()
        contestant()
    times = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, contestant in contestants.items():
            best = math.inf
            for _ in range(inner):
                start = time.perf_counter()
                contestant()
                best = min(best, time.perf_counter() - start)
            times[name].append(1e3 * best)
    return {name: float(np.median(values)) for name, values in times.items()}


def compiled(function, *arguments):
    """A contestant that calls the compiled function, the seconds of compilation, and the executable."""
    start = time.perf_counter()
    executable = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    return (lambda: jax.block_until_ready(executable(*arguments))), seconds, executable


def level_of(size):
    return round(math.log(size / 10, 4))


def is_icosphere(size):
    return abs(10 * 4 ** level_of(size) - size) < 0.1 * size


@functools.cache
def mesh_of(size):
    if is_icosphere(size):
        return ltl.shapes.icosphere(level_of(size))
    n_minor = round(math.sqrt(size / 2))
    return ltl.shapes.torus(n_major=2 * n_minor, n_minor=n_minor)


@functools.cache
def surface_of(size, dtype):
    surface = ltl.Surface.from_mesh(mesh_of(size), dtype=dtype)
    return surface, ltl.laplacian_matrix(surface)


def row(*cells):
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


def header(*cells):
    row(*cells)
    row(*("---" for _ in cells))


def ratio(times, reference="ltljax"):
    """The milliseconds of each contestant, and their ratio to the reference."""
    return [
        f"{value:.2f}" + ("" if name == reference else f" ({value / times[reference]:.2f})")
        for name, value in times.items()
    ]


def has(package):
    return importlib.util.find_spec(package) is not None


def apply_table(arguments):
    """The Laplacian."""
    print("### The Laplacian: milliseconds (and the ratio to ltljax)\n")
    on_host = arguments.device == "cpu"
    titles = None
    for dtype in map(np.dtype, arguments.dtypes):
        for size in arguments.sizes:
            surface, matrix = surface_of(size, dtype)
            for species in SPECIES:
                state = np.random.default_rng(0).random((surface.num_vertices,) + (species,) * (species > 1))
                state = state.astype(dtype)
                u = jnp.asarray(state)
                ours, seconds, _ = compiled(ltl.laplacian, surface, u)
                contestants = {"ltljax": ours, **jax_peers(matrix, u)}
                if on_host:
                    contestants |= host_peers(matrix, state)
                # Large products take seconds, so they get fewer rounds.
                rounds, inner = (ROUNDS, 3) if size <= 200_000 else (5, 2)
                times = compare(contestants, rounds, inner)
                if titles is None:
                    titles = tuple(times)
                    bandwidth = () if on_host else ("GB/s", "of a copy")
                    header("dtype", "vertices", "S", *titles, "compile (s)", *bandwidth)
                extra = () if on_host else achieved(surface, u, times["ltljax"])
                row(dtype, surface.num_vertices, species, *ratio(times), f"{seconds:.2f}", *extra)


def jax_peers(matrix, u):
    bcoo = jsparse.BCOO.from_scipy_sparse(matrix).sort_indices()
    bcsr = jsparse.BCSR.from_scipy_sparse(matrix)
    indices, weights = map(jnp.asarray, row_major_tables(matrix))

    def row_major(indices, weights, u):
        trailing = (1,) * (u.ndim - 1)
        return jnp.sum(weights.reshape(*weights.shape, *trailing) * (u[indices] - u[:, None]), axis=1)

    return {
        "BCOO": compiled(lambda m, u: m @ u, bcoo, u)[0],
        "BCSR": compiled(lambda m, u: m @ u, bcsr, u)[0],
        "row-major": compiled(row_major, indices, weights, u)[0],
    }


def host_peers(matrix, state):
    peers = {"SciPy": lambda: matrix @ state}
    if has("torch"):
        import torch

        parts = (torch.tensor(getattr(matrix, name)) for name in ("indptr", "indices", "data"))
        theirs, values = torch.sparse_csr_tensor(*parts, matrix.shape), torch.tensor(state)
        peers["torch"] = lambda: theirs @ values
    if has("numba"):
        kernel = numba_kernels()["sum"]
        indices, weights = row_major_tables(matrix)
        columns = state.reshape(len(state), -1)
        out = np.empty_like(columns)
        peers["Numba"] = lambda: kernel(indices, weights, columns, out)
    return peers


def achieved(surface, u, milliseconds):
    """The memory bandwidth of a Laplacian in GB/s, and its ratio to the bandwidth of a copy."""
    table, weights = surface.topology.diffusion.blocks[0], surface.geometry.laplacian_weights[0]
    rate = (table.indices.nbytes + weights.nbytes + 2 * u.nbytes) / milliseconds / 1e6
    big = jnp.zeros(1 << 27, jnp.float32)
    copy, _, _ = compiled(lambda x: x + 1, big)
    copied = 2 * big.nbytes / compare({"copy": copy})["copy"] / 1e6
    return f"{rate:.0f}", f"{100 * rate / copied:.0f} %"


def row_major_tables(matrix):
    """Indices and weights (V, K) of a matrix, as wide as its longest row; an empty slot holds the vertex itself."""
    parts = scipy.sparse.csr_array(matrix - scipy.sparse.diags_array(matrix.diagonal()))
    parts.eliminate_zeros()
    lengths = np.diff(parts.indptr)
    slot = np.arange(lengths.max())[None]
    position = np.minimum(parts.indptr[:-1, None] + slot, parts.nnz - 1)
    is_used = slot < lengths[:, None]
    indices = np.where(is_used, parts.indices[position], np.arange(len(lengths))[:, None]).astype(np.int32)
    return indices, np.where(is_used, parts.data[position], 0).astype(matrix.dtype)


@functools.cache
def numba_kernels():
    """Kernels fused by hand, with two threads, as a bound on the speed. Row-major tables are the fastest for them."""
    import numba

    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    options = dict(parallel=True, fastmath=True)

    @numba.njit(**options)
    def total(indices, weights, u, out):
        for v in numba.prange(u.shape[0]):
            for s in range(u.shape[1]):
                centre, accumulated = u[v, s], u[v, s] * 0
                for k in range(indices.shape[1]):
                    accumulated += weights[v, k] * (u[indices[v, k], s] - centre)
                out[v, s] = accumulated

    @numba.njit(**options)
    def step(indices, weights, u, out, dt, da, db, feed, kill):
        for v in numba.prange(u.shape[0]):
            a, b = u[v, 0], u[v, 1]
            la, lb = a * 0, b * 0
            for k in range(indices.shape[1]):
                j, w = indices[v, k], weights[v, k]
                la += w * (u[j, 0] - a)
                lb += w * (u[j, 1] - b)
            reaction = a * b * b
            out[v, 0] = a + dt * (da * la - reaction + feed * (1 - a))
            out[v, 1] = b + dt * (db * lb + reaction - (feed + kill) * b)

    return dict(sum=total, step=step)


def start_of(surface):
    """A random state, and a stable step length."""
    u = np.random.default_rng(0).random((surface.num_vertices, 2)).astype(surface.dtype)
    return u, surface.dtype.type(0.5 / float(ltl.operators.spectral_bound(surface)))


def step(surface, u, dt, kinetics):
    equation = ltl.ReactionDiffusion(DIFFUSIVITY, kinetics)
    return u + dt * equation.rate(jnp.zeros((), u.dtype), surface, u)


def kinetics_of(surface):
    return ltl.kinetics.gray_scott(jnp.asarray(FEED, surface.dtype), jnp.asarray(KILL, surface.dtype))


def step_table(arguments):
    """A step of a reaction-diffusion run."""
    count = 20
    print("### A step of a Gray-Scott reaction-diffusion run: milliseconds (and the ratio to ltljax)\n")
    titles = None
    for dtype in map(np.dtype, arguments.dtypes):
        for size in arguments.sizes:
            surface, matrix = surface_of(size, dtype)
            state, dt = start_of(surface)

            def run(surface, u, kinetics, dt=dt):
                return jax.lax.scan(lambda u, _: (step(surface, u, dt, kinetics), None), u, length=count)[0]

            ours, seconds, _ = compiled(run, surface, jnp.asarray(state), kinetics_of(surface))
            contestants = {"ltljax": ours}
            if arguments.device == "cpu":
                contestants |= host_runs(matrix, state, dt, count)
            times = {name: value / count for name, value in compare(contestants, rounds=7, inner=2).items()}
            if titles is None:
                titles = tuple(times)
                header("dtype", "vertices", *titles, "compile (s)")
            row(dtype, surface.num_vertices, *ratio(times), f"{seconds:.2f}")


def host_runs(matrix, state, dt, count):
    da, db, feed, kill = (state.dtype.type(value) for value in (*DIFFUSIVITY, FEED, KILL))

    def numpy_run():
        u = state
        for _ in range(count):
            diffused = matrix @ u
            a, b = u[:, 0], u[:, 1]
            reaction = a * b * b
            new = np.empty_like(u)
            new[:, 0] = a + dt * (da * diffused[:, 0] - reaction + feed * (1 - a))
            new[:, 1] = b + dt * (db * diffused[:, 1] + reaction - (feed + kill) * b)
            u = new

    runs = {"NumPy + SciPy": numpy_run}
    if has("numba"):
        kernel = numba_kernels()["step"]
        indices, weights = row_major_tables(matrix)
        buffers = np.empty_like(state), np.empty_like(state)

        def numba_run():
            u, (new, other) = state, buffers
            for _ in range(count):
                kernel(indices, weights, u, new, dt, da, db, feed, kill)
                u, new, other = new, other, new

        runs["Numba"] = numba_run
    return runs


def reverse_table(arguments):
    """The gradient of a run."""
    print(f"### The gradient of {STEPS} explicit steps: time relative to the run, and memory in states\n")
    print(
        "The gradient is with respect to two rates and the initial state. "
        "Memory is that of temporaries, as reported by XLA.\n"
    )
    inner = round(math.sqrt(STEPS))
    while STEPS % inner:
        inner += 1
    header(
        "dtype", "vertices", "run (ms)", "gradient", "memory", "with checkpoints", "memory", "scattering", "compile (s)"
    )
    for dtype in map(np.dtype, arguments.dtypes):
        for size in [size for size in arguments.sizes if size <= 200_000]:
            surface, _ = surface_of(size, dtype)
            scattering = ltl.Surface.from_mesh(mesh_of(size), dtype=dtype, differentiable=False)
            state, dt = start_of(surface)

            def run(kinetics, u, surface, checkpoints, dt=dt):
                advance = lambda u, _: (step(surface, u, dt, kinetics), None)  # noqa: E731
                several = lambda u, _: jax.lax.scan(advance, u, length=inner)  # noqa: E731
                if checkpoints:
                    u, _ = jax.lax.scan(jax.checkpoint(several), u, length=STEPS // inner)
                else:
                    u, _ = jax.lax.scan(advance, u, length=STEPS)
                return jnp.sum(u**2)

            data = kinetics_of(surface), jnp.asarray(state)
            contestants, memory, seconds = {}, {}, {}
            for name, target, checkpoints, derivative in (
                ("run", surface, False, run),
                ("gradient", surface, False, jax.value_and_grad(run, argnums=(0, 1))),
                ("checkpoints", surface, True, jax.value_and_grad(run, argnums=(0, 1))),
                ("scattering", scattering, False, jax.value_and_grad(run, argnums=(0, 1))),
            ):
                function = functools.partial(derivative, checkpoints=checkpoints)
                contestants[name], seconds[name], executable = compiled(
                    lambda k, u, s, f=function: f(k, u, s), *data, target
                )
                memory[name] = executable.memory_analysis().temp_size_in_bytes / state.nbytes
            times = compare(contestants, rounds=5, inner=1)
            over = {name: f"{times[name] / times['run']:.2f}" for name in times}
            states = {name: f"{memory[name]:.0f}" for name in memory}
            cells = over["gradient"], states["gradient"], over["checkpoints"], states["checkpoints"], over["scattering"]
            row(dtype, surface.num_vertices, f"{times['run']:.0f}", *cells, f"{seconds['gradient']:.2f}")


def order_table(arguments):
    """The cost of a bad order of the vertices."""
    print("### Order of the vertices: milliseconds of the Laplacian\n")
    header("vertices", "S", "as generated", "shuffled", "shuffled, then reordered", "reordering (s)")
    for size in [size for size in arguments.sizes if size >= 100_000]:
        mesh = mesh_of(size)
        order = np.random.default_rng(0).permutation(mesh.num_vertices)
        shuffled = ltl.Mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])
        start = time.perf_counter()
        reordered = shuffled.reordered()
        seconds = time.perf_counter() - start
        surfaces = [
            ltl.Surface.from_mesh(m, dtype="float32", differentiable=False) for m in (mesh, shuffled, reordered)
        ]
        for species in SPECIES:
            shape = (mesh.num_vertices,) + (species,) * (species > 1)
            u = jnp.asarray(np.random.default_rng(0).random(shape), jnp.float32)
            times = compare({str(k): compiled(ltl.laplacian, s, u)[0] for k, s in enumerate(surfaces)})
            row(mesh.num_vertices, species, *(f"{value:.2f}" for value in times.values()), f"{seconds:.2f}")


def build_table(arguments):
    """The time and peak memory of building a surface, each in a separate process."""
    print("### Building a surface: seconds, and bytes per vertex of memory in addition to the mesh\n")
    header("mesh", "vertices", "ltljax", "peak", "kept", "Paper", "robust-laplacian", "libigl")
    for kind in ("icosphere", "jittered torus"):
        for size in arguments.sizes:
            if kind == "icosphere" and not is_icosphere(size):
                continue
            call = [sys.executable, __file__, "--child", kind, str(size)]
            ours, paper = (run_child([*call, scheme]) for scheme in ("Monotone", "Paper"))
            peers = [run_child([*call, peer]) if has(peer) else None for peer in ("robust_laplacian", "igl")]
            row(
                kind, f"{ours['vertices']:.0f}", f"{ours['seconds']:.1f}", f"{ours['peak']:.0f}", f"{ours['kept']:.0f}",
                f"{paper['seconds']:.1f}", *("-" if peer is None else f"{peer['seconds']:.1f}" for peer in peers),
            )  # fmt: skip


def run_child(call):
    lines = subprocess.run(call, capture_output=True, text=True, check=True).stdout.split()
    return dict(zip(lines[::2], map(float, lines[1::2]), strict=True))


def child(kind, size, what):
    """One build, alone in its process, so that the peak memory belongs to it."""
    warnings.simplefilter("ignore")
    n_minor = round(math.sqrt(int(size) / 2))
    mesh = (
        ltl.shapes.icosphere(level_of(int(size)))
        if kind == "icosphere"
        else ltl.shapes.jittered_torus(2 * n_minor, n_minor, 0.25, seed=0)
    )
    jnp.zeros(1).block_until_ready()
    _ = mesh.boundary_loops  # computed here, because it belongs to the mesh
    peer = None if hasattr(ltl, what) else importlib.import_module(what)
    resident = lambda: int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()  # noqa: E731, SIM115
    resident_before, peak_before = resident(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    start = time.perf_counter()
    size_of_surface = 0
    if what == "robust_laplacian":
        peer.mesh_laplacian(mesh.vertices, mesh.faces)
    elif what == "igl":
        peer.cotmatrix(np.array(mesh.vertices), np.array(mesh.faces))
        peer.massmatrix(np.array(mesh.vertices), np.array(mesh.faces))
    else:
        surface = jax.block_until_ready(ltl.Surface.from_mesh(mesh, getattr(ltl, what)()))
        size_of_surface = sum(leaf.nbytes for leaf in jax.tree.leaves(surface))
    seconds = time.perf_counter() - start
    # If making the mesh needed more memory, the peak of the build is unknown; resident memory is a lower bound.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    above = max(peak if peak > peak_before else 0, resident()) - resident_before
    count = mesh.num_vertices
    print("vertices", count, "seconds", seconds, "peak", above / count, "kept", size_of_surface / count)


TABLES = dict(apply=apply_table, step=step_table, reverse=reverse_table, order=order_table, build=build_table)

if __name__ == "__main__":
    main()
