"""Homographies of patches from the displacements of their four corners, in closed form and batched.

All of it is elementwise arithmetic: matrix products would lose their precision under autocast.

The frame is the patch's own: cells of the fine grid relative to the patch centre, x right, y down; a patch of w x w
cells has its corner cells at (+-half, +-half), half = (w - 1) / 2. The corners are ordered as in the decoder's 2x2
output: top left, top right, bottom left, bottom right.
"""

import torch
from torch import Tensor


def make_corners(half: float, device: torch.device | None = None) -> Tensor:
    """(4, 2) float32: the corners of a patch."""
    return half * torch.tensor([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]], device=device)


def make_patch_grid(half: float, step: float = 1.0, device: torch.device | None = None) -> Tensor:
    """(N, 2) float32: the points of a square grid over [-half, half], row by row."""
    axis = torch.linspace(-half, half, round(2 * half / step) + 1, device=device)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def homography_from_corners(displacement: Tensor, half: float) -> Tensor:
    """The homographies that move the patch corners by the given displacements (section 3.2: 4-point DLT).

    displacement: (P, 4, 2) float32, cells. Returns (P, 3, 3) float32, patch of A -> patch of B, scaled so that the
    denominator is 1 at the patch centre. Heckbert's unit-square-to-quad form: no linear solve.
    """
    quad = displacement + make_corners(half, displacement.device)
    top_left, top_right, bottom_left, bottom_right = quad.unbind(dim=1)
    side_right = top_right - bottom_right
    side_bottom = bottom_left - bottom_right
    excess = top_left - top_right + bottom_right - bottom_left
    area = _cross(side_right, side_bottom)
    # A quad folded onto a line has no homography; a tiny area keeps the result finite, is_regular() rejects it.
    area = torch.where(area.abs() < 1e-6, torch.full_like(area, 1e-6), area)
    g = _cross(excess, side_bottom) / area
    h = _cross(side_right, excess) / area
    column_u = top_right - top_left + g[:, None] * top_right
    column_v = bottom_left - top_left + h[:, None] * bottom_left
    columns = [
        torch.cat([column_u, g[:, None]], dim=1),
        torch.cat([column_v, h[:, None]], dim=1),
        torch.cat([top_left, torch.ones_like(g)[:, None]], dim=1),
    ]
    # Unit square from patch: u = x / (2 half) + 1/2, likewise v.
    u, v, one = columns
    homography = torch.stack([u * (0.5 / half), v * (0.5 / half), 0.5 * u + 0.5 * v + one], dim=2)
    centre = homography[:, 2:, 2:]
    return homography / torch.where(centre.abs() < 1e-6, torch.full_like(centre, 1e-6), centre)


def apply_homography(homography: Tensor, points: Tensor) -> Tensor:
    """Map points: homography (P, 3, 3), points (N, 2) shared by all patches or (P, N, 2). Returns (P, N, 2)."""
    x, y = points[..., 0], points[..., 1]
    rows = homography[..., None]
    mapped_x, mapped_y, denominator = (rows[:, i, 0] * x + rows[:, i, 1] * y + rows[:, i, 2] for i in range(3))
    # Points near the horizon are of no use; the floor keeps their gradient finite.
    sign = torch.where(denominator < 0, -1.0, 1.0)
    denominator = sign * denominator.abs().clamp_min(0.05)
    return torch.stack([mapped_x / denominator, mapped_y / denominator], dim=-1)


def is_regular(homography: Tensor, half: float, limit: float = 3.0) -> Tensor:
    """(P,) bool: the patch stays convex, unmirrored, and its perspective scale varies by less than `limit`.

    homography: (P, 3, 3), scaled to denominator 1 at the centre. Training leaves the others out of the dense loss
    (it explodes there); matching drops them.
    """
    corners = make_corners(half, homography.device)
    g, h, i = homography[:, 2, :, None].unbind(dim=1)
    denominator = g * corners[:, 0] + h * corners[:, 1] + i
    inside = (denominator > 1 / limit) & (denominator < limit)
    return inside.all(dim=1) & (torch.linalg.det(homography) > 0.02)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
