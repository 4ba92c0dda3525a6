# SPDX-License-Identifier: Apache-2.0
"""Basis Universal textures of GLB files, decoded by `opengl_basisu` (extra `wiw[hm3d]`)."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw import _core
from wiw.errors import DependencyError, Error, FileError
from wiw.scenes.scans.glb import UNREADABLE, Glb
from wiw.scenes.scans.scan import import_options

EXTENSIONS = ("GOOGLE_texture_basis", "KHR_texture_basisu")
"""glTF extensions that name a texture's image in Basis Universal: bare `.basis` files, and KTX2 files."""


def find_images(glb: Glb) -> dict[int, int]:
    """Return the image of each texture that is in Basis Universal, by the texture's index."""
    found = {}
    for index, texture in enumerate(glb.items("textures")):
        named = texture.get("extensions", {})
        sources = [named[name]["source"] for name in EXTENSIONS if name in named]
        if sources and "source" not in texture:
            found[index] = int(sources[0])
    return found


def has_decoder() -> bool:
    """Return whether the decoder is installed."""
    return find_spec("opengl_basisu") is not None


def require_decoder(path: Path) -> None:
    """Check that the decoder is installed.

    Raises:
        DependencyError: it is not; names the extra that brings it.
    """
    if not has_decoder():
        raise DependencyError(
            f"{path}: its textures are in Basis Universal, which needs opengl_basisu: pip install 'wiw[hm3d]' (or "
            "--allow-missing-textures draws the scan grey)"
        )


def decode(data: bytes) -> NDArray[np.uint8]:
    """Return a `.basis` or KTX2 file's largest image, uint8 [H, W, 4], row 0 at the top of the picture.

    Raises:
        ValueError: it is damaged, or in a codec without 8-bit colours.
    """
    import opengl_basisu

    texture = opengl_basisu.open(data)
    image = np.asarray(texture.transcode(opengl_basisu.Target.RGBA8).data, np.uint8)
    image = image.reshape(texture.height, texture.width, 4)
    return image[::-1] if texture.y_flipped else image  # the flag says how rows are stored; no decoder undoes it


def with_png_textures(glb: Glb) -> tuple[Glb, list[str]]:
    """Return a copy of a file with its Basis Universal images as PNG, and a warning for each that has none."""
    images = find_images(glb)
    unique = sorted(set(images.values()))
    with ThreadPoolExecutor() as pool:
        encoded = dict(zip(unique, pool.map(lambda index: _encode(glb, index), unique), strict=True))
    document: dict[str, Any] = dict(glb.document)
    views, stored = [dict(view) for view in glb.items("bufferViews")], [dict(image) for image in glb.items("images")]
    textures = [dict(texture) for texture in glb.items("textures")]
    parts, size, warnings = [glb.body], len(glb.body), []
    for index in unique:
        png = encoded[index]
        if isinstance(png, str):
            warnings.append(f"image {index} of {glb.path.name} cannot be decoded: {png}")
            continue
        padding = -size % 4
        views.append({"buffer": 0, "byteOffset": size + padding, "byteLength": len(png)})
        parts += [bytes(padding), png]
        size += padding + len(png)
        stored[index] = {"bufferView": len(views) - 1, "mimeType": "image/png"}
    for texture, image in images.items():
        if not isinstance(encoded[image], str):
            textures[texture]["source"] = image
    document |= {"bufferViews": views, "images": stored, "textures": textures}
    document["buffers"] = [{"byteLength": size}, *glb.items("buffers")[1:]]
    return Glb(glb.path, document, b"".join(parts)), warnings


def _encode(glb: Glb, index: int) -> bytes | str:
    """Return an image as PNG, or why there is none."""
    try:
        image = decode(bytes(glb.view(glb.items("images")[index]["bufferView"])))
    except UNREADABLE as error:
        return str(error) or type(error).__name__
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    return bytes(cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA), fast)[1])


def import_textured(
    file: Path, options: Mapping[str, Any], up: str
) -> tuple[_core.scene.Scene, list[Path], list[Path], list[str]]:
    """Import a mesh, its Basis Universal textures decoded first.

    Returns:
        The scene, files read, files looked for in vain, and warnings of textures that cannot be decoded.

    Raises:
        FileError: it is missing or damaged.
        DependencyError: the decoder is not installed, and `options` do not allow textures to be missing.
    """
    plain = import_options(options, up)
    glb = Glb.read(file) if file.suffix.lower() == ".glb" else None
    try:
        if glb is None or not find_images(glb) or not _is_ready(file, options):
            scene, read, absent = _core.scene.import_scene(file, **plain)
            return scene, list(dict.fromkeys([file, *read])), list(absent), []
        decoded, warnings = with_png_textures(glb)
    except Error:
        raise
    except UNREADABLE as error:
        raise FileError(f"{file}: its textures cannot be read: {error} (damaged file?)") from error
    with TemporaryDirectory(prefix="wiw-scan-") as folder:
        copy = Path(folder) / file.name
        copy.write_bytes(decoded.bytes())
        scene, _, absent = _core.scene.import_scene(copy, **plain)
    return scene, [file], [path for path in absent if not path.is_relative_to(folder)], warnings


def _is_ready(file: Path, options: Mapping[str, Any]) -> bool:
    """Return whether the decoder is installed, which it need not be where textures may be missing."""
    if not options.get("allow_missing_textures"):
        require_decoder(file)
    return has_decoder()
