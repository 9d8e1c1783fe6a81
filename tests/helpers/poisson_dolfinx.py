"""Solve Laplace's equation with DOLFINx 0.5 on an exported mesh: for its own interpreter, on one process or more.

Fixed on ground, walls, roofs and top (markers 1 to 4), a given flux through the sides (5 to 8); the solution is
linear, so finite elements have it to rounding. Prints one line of JSON.
"""
# mypy: ignore-errors

import json
import sys

GRADIENT = (0.3, -0.2, 1.0)


def main(path: str) -> None:
    """Read, solve, print."""
    # Not at the top: pytest's interpreter, which looks into every file, has none of them.
    import numpy as np
    import ufl
    from dolfinx import fem, io
    from mpi4py import MPI
    from petsc4py import PETSc

    comm = MPI.COMM_WORLD
    with io.XDMFFile(comm, path, "r") as file:
        mesh = file.read_mesh(name="mesh")
        mesh.topology.create_entities(2)
        mesh.topology.create_connectivity(2, 3)
        tags = file.read_meshtags(mesh, name="facets")
    x = mesh.geometry.x
    # Coordinates of millions of metres would cost seven digits.
    low = comm.allreduce(x.min(axis=0).tolist(), lambda a, b: [min(p) for p in zip(a, b, strict=True)])
    x -= np.array(low)
    space = fem.FunctionSpace(mesh, ("Lagrange", 1))
    exact = fem.Function(space)
    exact.interpolate(lambda p: np.tensordot(GRADIENT, p, axes=1))
    fixed = np.concatenate([tags.find(marker) for marker in (1, 2, 3, 4)])
    condition = fem.dirichletbc(exact, fem.locate_dofs_topological(space, 2, fixed))
    u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
    ds = ufl.Measure("ds", mesh, subdomain_data=tags)
    flux = ufl.dot(ufl.as_vector(GRADIENT), ufl.FacetNormal(mesh))
    left = fem.form(ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx)
    right = fem.form(sum(flux * v * ds(marker) for marker in (5, 6, 7, 8)))
    matrix = fem.petsc.assemble_matrix(left, bcs=[condition])
    matrix.assemble()
    vector = fem.petsc.assemble_vector(right)
    fem.petsc.apply_lifting(vector, [left], bcs=[[condition]])
    vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    fem.petsc.set_bc(vector, [condition])
    solver = PETSc.KSP().create(comm)
    solver.setOperators(matrix)
    solver.setType("cg")
    solver.getPC().setType("jacobi")
    solver.setTolerances(rtol=1e-14, atol=1e-50, max_it=5000)
    found = fem.Function(space)
    solver.solve(vector, found.vector)
    found.x.scatter_forward()

    def total(form) -> float:
        return comm.allreduce(fem.assemble_scalar(fem.form(form)), MPI.SUM)

    one = fem.Constant(mesh, 1.0)
    own = tags.indices < mesh.topology.index_map(2).size_local
    report = {
        "processes": comm.size,
        "cells": mesh.topology.index_map(3).size_global,
        "facets": comm.allreduce(int(own.sum()), MPI.SUM),
        "areas": {str(marker): total(one * ds(marker)) for marker in range(1, 10)},
        "boundary": total(one * ufl.ds),
        "error": comm.allreduce(float(abs(found.x.array - exact.x.array).max()), MPI.MAX),
        "size": comm.allreduce(float(abs(exact.x.array).max()), MPI.MAX),
    }
    if comm.rank == 0:
        print(json.dumps(report))


if __name__ == "__main__":
    main(sys.argv[1])
