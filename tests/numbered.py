"""Pictures for tests of sources: numbered ones, and one picture in each encoding of ROS."""

from __future__ import annotations

from typing import Any

import numpy as np

BITS = 6  # of the number in a picture
WIDTH, HEIGHT = 384, 216


def numbered(number: int) -> np.ndarray:
    """A picture with its number as bright and dark bars, from the left."""
    bars = [255 if number >> bit & 1 else 0 for bit in range(BITS)]
    row = np.repeat(np.array(bars, np.uint8), WIDTH // BITS)
    return np.broadcast_to(row[None, :, None], (HEIGHT, WIDTH, 3)).copy()


def number_of(picture: np.ndarray) -> int | None:
    """The number in a picture; None if it is damaged, for example by packet loss."""
    height, width = picture.shape[:2]
    seen = [int(picture[height // 2, round((bit + 0.5) * width / BITS)].mean()) for bit in range(BITS)]
    clear = all(grey < 64 or grey > 192 for grey in seen)
    return sum((grey > 128) << bit for bit, grey in enumerate(seen)) if clear else None


def encoded(frame: np.ndarray, encoding: str) -> Any:
    """A frame of BGR in another encoding, and the RGB that it stands for."""
    if encoding in ("16UC1", "32FC1"):
        return _distances(frame, encoding)
    if encoding.endswith("16") and encoding != "mono16":
        narrow, rgb = encoded(frame, f"{encoding[:-2]}8")
        return (narrow.astype("<u2") * 256 + 77).view(np.uint8), rgb
    if encoding.startswith(("nv", "bayer")):
        return _plain(frame, encoding)
    return _simply_encoded(frame, {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8"}.get(encoding, encoding))


def _simply_encoded(frame: np.ndarray, encoding: str) -> Any:
    import cv2

    rgb = frame[..., ::-1]
    alpha = np.full((*frame.shape[:2], 1), 255, np.uint8)
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)[..., None]
    match encoding:
        case "mono8":
            return grey, np.repeat(grey, 3, 2)
        case "mono16":
            wide = grey.astype("<u2") * 257
            return wide.view(np.uint8), np.repeat(grey, 3, 2)
        case "rgb8" | "rgba8":
            return np.concatenate([rgb, alpha], 2)[..., : 3 if encoding == "rgb8" else 4], rgb
        case "bgr8" | "bgra8":
            return np.concatenate([frame, alpha], 2)[..., : 3 if encoding == "bgr8" else 4], rgb
    # Grey of 4:2:2, limited range: luma of full range is 255 / 219 of what is above 16.
    luma = np.clip(grey, 16, 235)
    chroma = np.full_like(luma, 128)
    pairs = [chroma, luma] if encoding in ("yuv422", "uyvy") else [luma, chroma]
    bright = np.clip((luma.astype(float) - 16) * 255 / 219, 0, 255).round().astype(np.uint8)
    return np.concatenate(pairs, 2), np.repeat(bright, 3, 2)


def _distances(frame: np.ndarray, encoding: str) -> Any:
    """Brightness as distances of up to 25 m, of which 20 m are white; where it is darkest, none is known."""
    grey = frame.max(axis=2, keepdims=True).astype(np.float32)
    metres = np.where(grey < 20, 0, grey * np.float32(25 / 255))
    shown = np.clip(metres * (255 / 20), 0, 255).astype(np.uint8)
    if encoding == "16UC1":
        data = (metres * 1000).round().astype("<u2")
    else:
        data = np.where(metres == 0, np.float32("nan"), metres).astype("<f4")
    return data.view(np.uint8), np.repeat(shown, 3, 2)


def _plain(frame: np.ndarray, encoding: str) -> Any:
    """The mean colour of a frame, everywhere: what a converter does between two colours does not matter."""
    import cv2

    height, width, _ = frame.shape
    colour = frame.reshape(-1, 3).mean(axis=0).round().astype(np.uint8) + np.array([90, 0, 40], np.uint8)
    plain = np.broadcast_to(colour, frame.shape).copy()
    if encoding.startswith("bayer"):
        data = np.zeros((height, width, 1), np.uint8)
        for index, name in enumerate(encoding[6:10]):
            data[index // 2 :: 2, index % 2 :: 2, 0] = colour["bgr".index(name)]
        return data, plain[..., ::-1]
    planar = cv2.cvtColor(plain, cv2.COLOR_BGR2YUV_I420)
    u, v = planar[height:].reshape(2, -1)
    chroma = np.stack([u, v] if encoding == "nv12" else [v, u], 1).reshape(height // 2, width)
    return np.concatenate([planar[:height], chroma])[..., None], plain[..., ::-1]
