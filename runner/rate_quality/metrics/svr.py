"""Support vector regression with a radial kernel, read from the files of two libraries, and evaluated.

    f(x) = sum_i alpha_i exp(-gamma |v_i - x|^2) - rho               (C.-C. Chang, C.-J. Lin, "LIBSVM", 2011, Eq. 10)

The files: libsvm's text (svm-train -s 3 -t 2) with ranges in the text of svm-scale, or both in OpenCV's YAML
(cv::ml::SVM::save; a matrix `range` whose rows are the minimum and maximum of each feature, scaled to [-1, 1]).
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from runner.errors import UserError, reason

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Kernels:
    """The result of training.

    vectors  [i, feature], of scaled features
    alpha    [i]
    """

    vectors: NDArray[np.float64]
    alpha: Vector
    rho: float
    gamma: float


@dataclass(frozen=True)
class Ranges:
    """Scaling of the features before training: from [least, most] of each to [lower, upper]."""

    least: Vector
    most: Vector
    lower: float = -1.0
    upper: float = 1.0


@dataclass(frozen=True)
class Regression:
    """A trained regression.

    identity  changes with the files
    """

    kernels: Kernels
    ranges: Ranges
    identity: str

    def __call__(self, features: Vector) -> float:
        """The prediction for one vector of features, unscaled."""
        offset = self.kernels.vectors - scale(features, self.ranges)
        return float(self.kernels.alpha @ np.exp(-self.kernels.gamma * (offset**2).sum(axis=1)) - self.kernels.rho)


def scale(features: Vector, ranges: Ranges) -> Vector:
    """Features scaled as in training; one that was constant there is 0, since svm-scale omits it."""
    span = ranges.most - ranges.least
    share = (features - ranges.least) / np.where(span > 0, span, 1)
    return np.where(span > 0, ranges.lower + (ranges.upper - ranges.lower) * share, 0.0)


def load(model: Path, ranges: Path, features: int) -> Regression:
    """Read a regression of this many features, each file in either form.

    raises  UserError that names file, location and rule
    """
    found, spans = _read(model), _read(ranges)
    kernels = (_opencv_kernels if _is_opencv(found) else _libsvm_kernels)(model, found, features)
    scaling = (_opencv_ranges if _is_opencv(spans) else _libsvm_ranges)(ranges, spans, features)
    digest = hashlib.sha256("\0".join((found, spans)).encode()).hexdigest()
    return Regression(kernels, scaling, digest[:16])


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError as error:
        raise UserError(str(path), "", None, reason(error)) from None
    except ValueError:
        raise UserError(str(path), "", None, "is not text") from None


def _is_opencv(text: str) -> bool:
    return text.startswith("%YAML")


def _expect(path: Path, place: str, found: object, rule: str, good: bool) -> None:
    if not good:
        raise UserError(str(path), place, repr(found), rule)


# --- libsvm ---------------------------------------------------------------------------------------------------------


def _libsvm_kernels(path: Path, text: str, features: int) -> Kernels:
    """Lines of settings, then SV, then per vector its alpha and its features as index:value, zeros left out."""
    head, _, body = text.partition("\nSV\n")
    settings = {name: value for name, _, value in (line.partition(" ") for line in head.splitlines())}
    for name, value in (("svm_type", "epsilon_svr"), ("kernel_type", "rbf")):
        _expect(path, name, settings.get(name), f"must be {value}", settings.get(name) == value)
    rho, gamma = (_number(path, name, settings.get(name, "")) for name in ("rho", "gamma"))
    rows = [line.split() for line in body.splitlines() if line.strip()]
    total = int(_number(path, "total_sv", settings.get("total_sv", "")))
    _expect(path, "SV", len(rows), f"must have {total} lines, as total_sv states", len(rows) == total > 0)
    vectors = np.zeros((total, features))
    alpha = np.zeros(total)
    for i, (weight, *cells) in enumerate(rows):
        place = f"SV {i + 1}"
        alpha[i] = _number(path, place, weight)
        for cell in cells:
            index, _, value = cell.partition(":")
            vectors[i, _feature(path, place, index, features)] = _number(path, place, value)
    return Kernels(vectors, alpha, rho, gamma)


def _libsvm_ranges(path: Path, text: str, features: int) -> Ranges:
    """A line x, a line with lower and upper, then for each feature its index, minimum and maximum."""
    rows = [line.split() for line in text[text.find("x") :].splitlines() if line.strip()]
    _expect(path, "", rows[:1], "must have a line x before the ranges of features", rows[:1] == [["x"]])
    for number, row in enumerate(rows[1:]):
        _expect(path, f"line {number + 2}", " ".join(row), "must have 2 numbers, then 3", len(row) == 2 + (number > 0))
    least, most = np.zeros(features), np.zeros(features)
    numbers = [[_number(path, "x", cell) for cell in row] for row in rows[1:]]
    _expect(path, "x", len(numbers), "must have a line of lower and upper", bool(numbers))
    for cells, (_, low, high) in zip(rows[2:], numbers[1:], strict=True):
        at = _feature(path, "x", cells[0], features)
        least[at], most[at] = low, high
    return Ranges(least, most, *numbers[0])


def _feature(path: Path, place: str, text: str, features: int) -> int:
    """Index of a feature that libsvm counts from 1."""
    good = text.isdecimal() and 1 <= int(text) <= features
    _expect(path, place, text, f"must be the number of a feature, 1 to {features}", good)
    return int(text) - 1


def _number(path: Path, place: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    _expect(path, place, text, "must be a finite number", math.isfinite(value))
    return value


# --- OpenCV ---------------------------------------------------------------------------------------------------------
# Read as the YAML that it nearly is: cv2.FileStorage crashes the process on damaged files.


def _opencv_kernels(path: Path, text: str, features: int) -> Kernels:
    """The first node of a file that cv::ml::SVM::save wrote."""
    node = _mapping(next(iter(_document(path, text).values())))
    kernel, decisions = _mapping(node.get("kernel")), node.get("decision_functions")
    kind, shape = node.get("svmType", ""), kernel.get("type", "")
    _expect(path, "svmType", kind, "must be EPS_SVR", kind == "EPS_SVR")
    _expect(path, "kernel.type", shape, "must be RBF", shape == "RBF")
    decision = _mapping(decisions[0] if isinstance(decisions, list) and decisions else None)
    alpha = _row(path, "alpha", decision.get("alpha"))
    rows = node.get("support_vectors")
    vectors = [_row(path, "support_vectors", row) for row in (rows if isinstance(rows, list) else ())]
    sizes = {len(row) for row in vectors}
    _expect(path, "support_vectors", sorted(sizes), f"each must have {features} features", sizes == {features})
    _expect(path, "alpha", len(alpha), f"must have {len(vectors)} numbers", len(alpha) == len(vectors))
    rho, gamma = (_real(path, name, at.get(name)) for name, at in (("rho", decision), ("gamma", kernel)))
    return Kernels(np.array(vectors), np.array(alpha), rho, gamma)


def _opencv_ranges(path: Path, text: str, features: int) -> Ranges:
    """The matrix `range`: a row of the minimum, a row of the maximum of each feature."""
    found = _mapping(_document(path, text).get("range"))
    shape = (found["rows"], found["cols"]) if {"rows", "cols", "data"} <= found.keys() else None
    values = _row(path, "range", found.get("data"))
    good = shape == (2, features) and len(values) == 2 * features
    _expect(path, "range", shape, f"must be a matrix of 2 x {features}", good)
    return Ranges(np.array(values[:features]), np.array(values[features:]))


class _OpenCvLoader(yaml.SafeLoader):
    """YAML with OpenCV's own tag for matrices, which are mappings."""


def _matrix(loader: _OpenCvLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_OpenCvLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _document(path: Path, text: str) -> dict[str, Any]:
    """A file whose first line is OpenCV's own form of a YAML directive."""
    try:
        document = yaml.load(text.partition("\n")[2], _OpenCvLoader)
    except yaml.YAMLError:
        raise UserError(str(path), "", None, "is not what OpenCV writes") from None
    _expect(path, "", text[:20], "is empty", isinstance(document, dict) and bool(document))
    return dict(document)


def _mapping(node: Any) -> dict[str, Any]:
    return node if isinstance(node, dict) else {}


def _row(path: Path, place: str, node: Any) -> list[float]:
    return [_real(path, place, item) for item in (node if isinstance(node, list) else ())]


def _real(path: Path, place: str, node: Any) -> float:
    """A number; YAML 1.1 reads OpenCV's "1.5e-01" as one and its "2.e+00" as text."""
    try:
        value = math.nan if isinstance(node, bool) else float(node)
    except (TypeError, ValueError):
        value = math.nan
    _expect(path, place, node, "must be a finite number", math.isfinite(value))
    return value
