"""Photographs without poses: structure from motion by pycolmap (Schönberger & Frahm 2016, CVPR).

A last bundle adjustment takes the residuals, in px, as Cauchy-distributed (Triggs et al. 2000, LNCS 1883:298), so that
wrong matches within the mapper's bound of 4 px weigh little.
"""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

from PIL import Image

from splatsoil.errors import MeasurementError, ParameterError, SetWarning
from splatsoil.measurement.colmap import read_colmap
from splatsoil.measurement.frames import Frame


def posed(folder: Path) -> tuple[Frame, ...]:
    """Those photographs of a folder, and of folders in it, that can be posed, in a world of any scale and direction.

    Photographs in one folder are taken to be by one camera and lens, whose focal length and radial distortion are
    estimated, too. A SetWarning names those that cannot be posed.

    Raises:
        ParameterError: pycolmap isn't installed.
        MeasurementError: fewer than three photographs can be posed in one world.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise ParameterError("--sfm: needs pycolmap; pip install 'splatsoil[sfm]'") from error
    if not folder.is_dir():
        raise MeasurementError("no such folder; give the folder of the photographs", file=folder)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value  # all else is for its developers
    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory() as temporary:
        database, model = Path(temporary) / "database.db", Path(temporary) / "model"
        try:
            pycolmap.extract_features(database, folder, camera_mode=pycolmap.CameraMode.PER_FOLDER)
            pycolmap.match_exhaustive(database)
            found = pycolmap.incremental_mapping(database, folder, temporary)
        except (RuntimeError, ValueError) as error:
            raise MeasurementError(f"pycolmap cannot pose its photographs ({error})", file=folder) from error
        best = max(found.values(), key=lambda one: one.num_reg_images(), default=None)
        if best is None or best.num_reg_images() < 3:
            raise MeasurementError(
                "its photographs cannot be posed: three or more must show each place, sharply and from directions that"
                " differ by 30° at most",
                file=folder,
            )
        robust, adjusted = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
        robust.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        for image in best.reg_image_ids():
            adjusted.add_image(image)
        adjusted.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(robust, adjusted, best).solve()
        model.mkdir()
        best.write_binary(str(model))
        frames = read_colmap(model, folder)
    known = Image.registered_extensions()
    photographs = {p for p in folder.rglob("*") if p.suffix.lower() in known}
    if left := sorted(p.name for p in photographs - {frame.path for frame in frames}):
        warnings.warn(f"views: {len(left)} photographs cannot be posed: {', '.join(left)}.", SetWarning, stacklevel=2)
    return frames
