"""Numbers that define the image of Gaussians; they follow the original 3-D Gaussian splatting code and gsplat."""

from __future__ import annotations

DILATION = 0.3
"""Variance added to both axes of every projected Gaussian, in px²: a splat is never thinner than about half a pixel."""

PIXEL_VARIANCE = 0.1
"""The same with antialiasing: about that of a pixel's own square, 1/12 px² (Mip-splatting's value). What is added more
sums up where thin Gaussians lie behind each other, so that soil seen at a grazing angle ends too late."""

ALPHA_MAX = 0.99
"""Largest opacity a single Gaussian can have in a pixel; the gradient is zero where this limit acts."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian is skipped in pixels where its opacity is smaller than this."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished when the next Gaussian would lower its transmittance to this; that Gaussian is not blended."""

ANTIALIAS_MIN = 0.005
"""Smallest antialiasing factor √(det Σ / det Σ′); it keeps needles from vanishing entirely."""

NEAR = 0.01
"""Gaussians whose centre is nearer than this to a perspective camera's plane (m) are not drawn."""

REACH_TO_EYE = 3.0
"""Gaussians that reach a perspective camera's plane with this many standard deviations are not drawn. The linear map
that stands for perspective fails there: a disc on the ground beside the camera would be a haze over the whole picture.
The original code avoids some of that by a narrower limit on tangents, see below."""

TANGENT_LIMIT = 3.0
"""Largest |x/z| and |y/z| at which the perspective Jacobian is evaluated. The original code takes 1.3 times the
half-angle of the image instead, which makes a cropped picture differ from the crop of the full one; a fixed limit does
not."""

TILE = 16
"""Side of the square screen tiles, in px; the CPU kernels hold one row of a tile in one 16-wide vector."""

MAX_CHANNELS = 8
"""Most feature channels that can be blended in one call."""
