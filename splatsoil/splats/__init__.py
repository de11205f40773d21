"""Gaussian splatting: sets of Gaussians, their files, images and the images' gradients, on CPU and CUDA."""

from splatsoil.splats.gaussians import Gaussians
from splatsoil.splats.metrics import psnr, ssim, ssim_map
from splatsoil.splats.ply import load_ply, save_ply
from splatsoil.splats.rasteriser import Rendering, rasterise, rasterise_features

__all__ = [
    "Gaussians",
    "Rendering",
    "load_ply",
    "psnr",
    "rasterise",
    "rasterise_features",
    "save_ply",
    "ssim",
    "ssim_map",
]
