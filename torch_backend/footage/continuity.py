"""Measures the overlap of two frames: the number of features that one homography maps onto each other.

The local contrast of both pictures is normalised first, so that brightness and colour hardly matter. Mirrored and
negative pictures do not match.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH = 320
"""Width in pixels of the compared pictures."""
_FEATURES = 500
# Minimum number of features for a comparison. A picture with fewer is blank or smeared.
_LEAST_FEATURES = 40
# Largest error of an inlier to the homography, in pixels. It leaves room for parallax.
_TOLERANCE = 5.0
# Value added to the local contrast, in 8-bit steps, so that noise in black does not become texture.
_FLOOR = 2.0
# Largest ratio of the best match's distance to the second best match's distance (Lowe's ratio).
_DISTINCT = 0.8


@dataclass(frozen=True)
class Link:
    """Overlap of two pictures."""

    count: int = 0
    """Number of common features: inliers of the homography."""
    share: float = 0.0
    """Common features as a share of the features of the picture with fewer features."""
    shift: float = 1.0
    """Median displacement of the common features, as a share of the picture's width."""
    points: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), np.float32), repr=False)
    """[count, 2] positions of the common features in the second picture, pixels."""
    homography: NDArray[np.float64] = field(default_factory=lambda: np.eye(3), repr=False)
    """[3, 3] from the first picture to the second, pixels."""


@dataclass(frozen=True)
class Features:
    """Features of a picture."""

    points: NDArray[np.float32]
    """[N, 2] pixels."""
    descriptors: NDArray[Any]
    """[N, D] uint8 of ORB, float32 of SIFT."""
    sharpness: float
    """Mean square of the Laplacian of the picture with normalised contrast: sharpness independent of brightness."""

    @property
    def is_sufficient(self) -> bool:
        """True if the picture has enough features for a comparison."""
        return len(self.points) >= _LEAST_FEATURES


def quick_features(grey: NDArray[np.uint8]) -> Features:
    """ORB features of a grey picture [h, w]. Takes 10 ms. Unrelated pictures share up to 4 % of them by chance."""
    return _features(grey, cv2.ORB_create(_FEATURES, 1.3, 4, edgeThreshold=9, patchSize=21, fastThreshold=7))  # type: ignore[attr-defined]


def sure_features(grey: NDArray[np.uint8]) -> Features:
    """SIFT features of a grey picture [h, w]. Takes 100 ms; used for pictures with few common ORB features."""
    return _features(grey, cv2.SIFT_create(2 * _FEATURES, contrastThreshold=0.02))  # type: ignore[attr-defined]


def link(a: Features, b: Features) -> Link:
    """The overlap of two pictures of the same size."""
    if min(len(a.points), len(b.points)) < 8:
        return Link()
    if a.descriptors.dtype == np.uint8:
        matches = list(cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(a.descriptors, b.descriptors))
    else:
        pairs = [pair for pair in cv2.BFMatcher().knnMatch(a.descriptors, b.descriptors, 2) if len(pair) == 2]
        matches = [best for best, second in pairs if best.distance < _DISTINCT * second.distance]
    if len(matches) < 8:
        return Link()
    at_a, at_b = a.points[[m.queryIdx for m in matches]], b.points[[m.trainIdx for m in matches]]
    cv2.setRNGSeed(0)  # makes RANSAC deterministic
    # Both are None without a homography, which OpenCV's type stubs omit.
    answer: tuple[Any, Any] = cv2.findHomography(at_a, at_b, cv2.RANSAC, _TOLERANCE, maxIters=500)
    homography, found = answer
    inside = np.zeros(len(matches), bool) if found is None else np.asarray(found).ravel() > 0
    if not inside.any():
        return Link()
    way = float(np.median(np.linalg.norm(at_b[inside] - at_a[inside], axis=1)))
    count = int(inside.sum())
    return Link(
        count, count / min(len(a.points), len(b.points)), way / WIDTH, at_b[inside], np.asarray(homography, np.float64)
    )


def small_grey(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """A picture [H, W, 3] resized to [h, `WIDTH`] uint8 grey."""
    pixels = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
    height, width = pixels.shape[:2]
    way = cv2.INTER_AREA if width > WIDTH else cv2.INTER_CUBIC
    small = cv2.resize(pixels, (WIDTH, max(8, round(height * WIDTH / width))), interpolation=way)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8)


def _features(grey: NDArray[np.uint8], detector: Any) -> Features:
    flat = _with_equal_contrast(grey)
    points, descriptors = detector.detectAndCompute(flat, None)
    where = np.array([point.pt for point in points], np.float32).reshape(-1, 2)
    sharpness = float(np.square(cv2.Laplacian(flat, cv2.CV_32F)).mean())
    return Features(where, np.zeros((0, 1), np.uint8) if descriptors is None else descriptors, sharpness)


def _with_equal_contrast(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    detail = grey.astype(np.float32)
    detail -= cv2.GaussianBlur(detail, (0, 0), 12.0)
    contrast = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), 12.0))
    return np.clip(128.0 + 40.0 * detail / (contrast + _FLOOR), 0, 255).astype(np.uint8)
