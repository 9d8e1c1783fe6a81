"""Roofs that meet in a vertex: which do, and on which layers they can be (step 3.4 with party walls).

In the layered mesh a roof is one layer of each of its columns. Where roofs of different heights meet, they must
lie on different layers, in the order of their heights; roofs of equal height must share one.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.data.errors import GeometryError
from pipeline.data.kernel import kernel
from pipeline.geometry.components import join_pairs


def check_groups(roof: NDArray[np.float64], group: NDArray[np.int32]) -> None:
    """Refuse a group of two heights.

    Raises
    ------
    ValueError
        With the group and two of its heights.
    """
    order = np.argsort(group, kind="stable")
    same = group[order[1:]] == group[order[:-1]]
    differs = np.flatnonzero(same & (roof[order[1:]] != roof[order[:-1]]))
    if len(differs):
        first, second = order[differs[0]], order[differs[0] + 1]
        raise ValueError(f"group {group[first]} has roofs at {roof[first]} m and {roof[second]} m")


def join_equal_roofs(
    pairs: NDArray[np.int64], roof: NDArray[np.float64], group: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Join groups that touch and have the same height: there is no wall between them.

    Parameters
    ----------
    pairs : int64, (p, 2)
        Buildings that touch, as from `adjacent_houses`.
    roof : float64, (b,)
        Absolute roof heights (m).
    group : int32, (b,)
        Group of each building.

    Returns
    -------
    int32, (b,)
        A group for each building.
    """
    equal = pairs[roof[pairs[:, 0]] == roof[pairs[:, 1]]]
    _, first, member = np.unique(group, return_index=True, return_inverse=True)
    links = np.concatenate((equal, np.column_stack((first[member], np.arange(len(roof))))))
    joined: NDArray[np.int32] = np.unique(join_pairs(len(roof), links), return_inverse=True)[1].astype(np.int32)
    return joined


def part_neighbours(
    pairs: NDArray[np.int64],
    roof: NDArray[np.float64],
    group: NDArray[np.int32],
    removed: NDArray[np.int32],
    polygons: NDArray[np.object_],
    *,
    n_layers: int,
) -> tuple[NDArray[np.int32], int]:
    """Put roofs that meet on different layers, in the order of their heights.

    Parameters
    ----------
    pairs : int64, (p, 2)
        Buildings that touch, as from `adjacent_houses`.
    roof : float64, (b,)
        Absolute roof heights (m).
    group : int32, (b,)
        Groups, those of equal height joined (`join_equal_roofs`).
    removed : int32, (b,)
        Layers removed in each building if it stood alone: the same in a group.
    polygons : object, (b,)
        Footprints, for the place in a message.
    n_layers : int
        Layers of the slab.

    Returns
    -------
    int32, (b,)
        Layers removed in each building, from 1 to ``n_layers - 1``.
    int
        Groups that are not on the layer that they had.

    Raises
    ------
    GeometryError
        If more roofs follow each other upwards than there are layers.

    Notes
    -----
    By ascending height, a roof goes to its own layer or to the one above its highest lower neighbour; then,
    from the top down, what does not fit comes down again as little as it must. Chains of neighbours that do not
    touch do not see each other, and the order of buildings does not matter. Cost is that of sorting the pairs.
    """
    _, first, member = np.unique(group, return_index=True, return_inverse=True)
    layer = removed[first[member]].astype(np.int64)
    lower, higher = _order_pairs(pairs, roof, first[member])
    upwards = np.lexsort((higher, roof[higher]))
    _raise_layers(layer, lower[upwards], higher[upwards])
    np.minimum(layer, n_layers - 1, out=layer)
    downwards = np.lexsort((lower, -roof[lower]))
    _lower_layers(layer, lower[downwards], higher[downwards])
    if len(layer) and layer[first].min() < 1:
        worst = first[int(layer[first].argmin())]
        place = polygons[worst].representative_point()
        raise GeometryError(
            f"roof at {roof[worst]:.1f} m near ({place.x:.1f}, {place.y:.1f}), step 3.4: more roofs of different "
            f"heights rise above each other there than fit below the domain's top in {n_layers} layers; lower "
            "--layer-height, or take --mesher adaptive"
        )
    return layer[first[member]].astype(np.int32), int((layer[first] != removed[first]).sum())


def _order_pairs(
    pairs: NDArray[np.int64], roof: NDArray[np.float64], leader: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Leaders of the lower and of the higher group of each pair that is not within one; each pair once."""
    ends = leader[pairs]
    ends = ends[ends[:, 0] != ends[:, 1]]
    swapped = roof[ends[:, 0]] > roof[ends[:, 1]]
    ends[swapped] = ends[swapped][:, ::-1]
    ends = np.unique(ends, axis=0)
    return ends[:, 0], ends[:, 1]


@kernel
def _raise_layers(layer: NDArray[np.int64], lower: NDArray[np.int64], higher: NDArray[np.int64]) -> None:
    for k in range(len(lower)):
        layer[higher[k]] = max(layer[higher[k]], layer[lower[k]] + 1)


@kernel
def _lower_layers(layer: NDArray[np.int64], lower: NDArray[np.int64], higher: NDArray[np.int64]) -> None:
    for k in range(len(lower)):
        layer[lower[k]] = min(layer[lower[k]], layer[higher[k]] - 1)
