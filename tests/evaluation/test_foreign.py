"""Other systems' files give the numbers that the same predictions give in memory."""

from __future__ import annotations

import inspect

import cv2
import numpy as np
import pytest
import torch

from saunet.errors import ConfigError, DataError
from saunet.evaluation import evaluate
from saunet.evaluation.foreign import ForeignArray, ForeignFolder, file_stem, foreign_predictor
from saunet.metrics.protocols import protocol

DISPARITY = np.random.default_rng(0).random((5, 6, 10)).astype(np.float32) * 0.2 + 0.02
NAMES = [f"day/drive_{i % 2} {i:010d} l" for i in range(5)]


def batches(sizes=(2, 2, 1)):
    generator = torch.Generator().manual_seed(1)
    start = 0
    for size in sizes:
        yield {
            "target": torch.zeros(size, 3, 6, 10),
            "name": NAMES[start : start + size],
            "depth": torch.rand(size, 1, 12, 20, generator=generator) * 60 + 1,
            "depth_size": torch.tensor([[12, 20]] * size),
        }
        start += size


def score(predictor):
    return evaluate({"m": predictor}, batches(), [protocol("metric")], progress=False).errors("m", "metric")


def in_memory():
    start = 0

    def predictor(batch):
        nonlocal start
        start += len(batch["name"])
        return torch.from_numpy(DISPARITY[start - len(batch["name"]) : start])[:, None]

    return score(predictor)


@pytest.mark.parametrize("shape", [(5, 6, 10), (5, 1, 6, 10)])
def test_array_of_disparities(tmp_path, shape):
    np.save(tmp_path / "disps.npy", DISPARITY.reshape(shape))
    np.testing.assert_array_equal(score(ForeignArray(tmp_path / "disps.npy", NAMES)), in_memory())


def test_array_of_depths(tmp_path):
    np.save(tmp_path / "depth.npy", 1 / DISPARITY.astype(np.float64))
    np.testing.assert_allclose(score(ForeignArray(tmp_path / "depth.npy", NAMES, "depth")), in_memory(), rtol=1e-5)


def test_reference_array_gives_the_published_loop(tmp_path, reference):
    data = reference("metrics")
    np.save(tmp_path / "disps.npy", data["eigen_disparity"])
    truth = torch.from_numpy(data["eigen_gt"])[:, None]
    batch = {"name": ["a", "b"], "target": None, "depth": truth, "depth_size": torch.tensor([[375, 1242]] * 2)}
    result = evaluate(
        {"m": ForeignArray(tmp_path / "disps.npy", ["a", "b"])}, [batch], [protocol("eigen_camera_z")], progress=False
    )
    expected = data["eigen_metrics_median_scaled"].mean(0)
    np.testing.assert_allclose(result.summaries()[0].errors[:4], expected[:4], rtol=1e-6)


@pytest.mark.parametrize("match", ["order", "name"])
@pytest.mark.parametrize("kind", ["npy", "png"])
def test_folder(tmp_path, match, kind):
    for i, disparity in enumerate(DISPARITY):
        stem = f"{i + 8}" if match == "order" else file_stem(NAMES[i])
        if kind == "npy":
            np.save(tmp_path / f"{stem}.npy", disparity)
        else:
            cv2.imwrite(str(tmp_path / f"{stem}.png"), np.round(256 / disparity).astype(np.uint16))
    (tmp_path / "notes.txt").write_text("not a prediction")
    found = score(ForeignFolder(tmp_path, NAMES, "disparity", match))
    np.testing.assert_allclose(
        found, in_memory(), **({"atol": 0.0} if kind == "npy" else {"rtol": 0.01, "atol": 0.005})
    )


def test_an_array_may_hold_images_that_are_not_evaluated_and_in_another_order(tmp_path):
    order = [NAMES[3], "no truth", *NAMES[:3], NAMES[4]]
    array = np.stack([DISPARITY[3], np.full((6, 10), 9.0), *DISPARITY[:3], DISPARITY[4]]).astype(np.float32)
    np.save(tmp_path / "disps.npy", array)
    np.testing.assert_array_equal(score(ForeignArray(tmp_path / "disps.npy", order)), in_memory())


def test_a_path_says_what_it_is(tmp_path):
    np.save(tmp_path / "disps.npy", DISPARITY)
    array = foreign_predictor(tmp_path / "disps.npy", NAMES)
    assert isinstance(array, ForeignArray)
    assert array.values == "disparity"
    (tmp_path / "depth").mkdir()
    for name, disparity in zip(NAMES, DISPARITY, strict=True):
        np.save(tmp_path / "depth" / f"{file_stem(name)}.npy", 1 / disparity)
    np.testing.assert_allclose(score(foreign_predictor(tmp_path / "depth", (), match="name")), in_memory(), rtol=1e-5)
    with pytest.raises(DataError, match="no predictions at"):
        foreign_predictor(tmp_path / "nothing", NAMES)
    with pytest.raises(ConfigError, match="match is 'nam'"):
        foreign_predictor(tmp_path / "depth", NAMES, match="nam")
    with pytest.raises(ConfigError, match="values is 'depths'"):
        foreign_predictor(tmp_path / "depth", NAMES, "depths")


def test_file_stem():
    assert file_stem("2011_09_26/drive_0001_sync 0000000005 l") == "2011_09_26_drive_0001_sync_0000000005_l"


def test_wrong_count(tmp_path):
    np.save(tmp_path / "disps.npy", DISPARITY)
    with pytest.raises(DataError, match="holds 5 predictions for 6 images"):
        ForeignArray(tmp_path / "disps.npy", [*NAMES, "one more"])
    with pytest.raises(DataError, match=f"no prediction for image '{NAMES[0]}'; it belongs to another split"):
        score(ForeignArray(tmp_path / "disps.npy", [f"other {i}" for i in range(5)]))
    (tmp_path / "folder").mkdir()
    np.save(tmp_path / "folder" / "0.npy", DISPARITY[0])
    with pytest.raises(DataError, match="holds 1 predictions for 2 images"):
        ForeignFolder(tmp_path / "folder", NAMES[:2], match="order")
    with pytest.raises(DataError, match=r"has no file 'day_drive_0_0000000000_l\.npy'"):
        score(ForeignFolder(tmp_path / "folder", match="name"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not numpy", "as a numpy array"),
        (np.zeros((5, 6), np.float32), r"holds shape \(5, 6\)"),
        (np.zeros((5, 6, 10), np.uint8), "does not hold floating-point numbers"),
    ],
)
def test_broken_arrays(tmp_path, content, message):
    path = tmp_path / "disps.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    with pytest.raises(DataError, match=message):
        ForeignArray(path, NAMES)


def read_all(folder):
    names = NAMES[: len(list(folder.iterdir()))]
    return ForeignFolder(folder, names, match="order")({"name": names})


def test_broken_files_of_a_folder(tmp_path):
    with pytest.raises(DataError, match="there is no folder"):
        ForeignFolder(tmp_path / "missing")
    with pytest.raises(DataError, match="holds no prediction"):
        ForeignFolder(tmp_path)
    path = tmp_path / "0000.png"
    whole = cv2.imencode(".png", np.full((6, 10), 2560, np.uint16))[1].tobytes()
    for data, message in ((b"", "is empty"), (b"junk", "is not an image"), (whole[:-12], "is truncated")):
        path.write_bytes(data)
        with pytest.raises(DataError, match=rf"0000\.png {message}"):
            read_all(tmp_path)
    cv2.imwrite(str(path), np.full((6, 10), 200, np.uint8))
    with pytest.raises(DataError, match="a depth map is one channel of 16-bit numbers"):
        read_all(tmp_path)
    cv2.imwrite(str(path), np.zeros((6, 10), np.uint16))
    with pytest.raises(DataError, match="pixels without depth"):
        read_all(tmp_path)
    cv2.imwrite(str(path), np.full((6, 10), 2560, np.uint16))
    cv2.imwrite(str(tmp_path / "0001.png"), np.full((6, 9), 2560, np.uint16))
    with pytest.raises(DataError, match="differ in size"):
        read_all(tmp_path)
    path.unlink()
    (tmp_path / "0001.png").unlink()
    np.save(tmp_path / "a.npy", np.ones((2, 3, 4), np.float32))
    with pytest.raises(DataError, match=r"holds shape \(2, 3, 4\)"):
        read_all(tmp_path)


def test_unknown_words(tmp_path):
    np.save(tmp_path / "a.npy", DISPARITY)
    with pytest.raises(ConfigError, match="did you mean 'depth'"):
        inspect.unwrap(ForeignArray.__init__)(ForeignArray.__new__(ForeignArray), tmp_path / "a.npy", NAMES, "depths")
    with pytest.raises(ConfigError, match="match is 'names'"):
        inspect.unwrap(ForeignFolder.__init__)(ForeignFolder.__new__(ForeignFolder), tmp_path, NAMES, "depth", "names")


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_disparity_that_is_nowhere_positive_is_no_prediction(tmp_path, value):
    maps = np.full((2, 3, 4), value, np.float32)
    maps[0, 1, 1] = 0.5  # some pixels that are infinitely far away are normal
    np.save(tmp_path / "disps.npy", maps)
    predict = ForeignArray(tmp_path / "disps.npy", ["a", "b"])
    assert predict({"name": ["a"]}).max() == 0.5
    with pytest.raises(DataError, match=r"disps.npy' has disparity that is nowhere above 0 in an image"):
        predict({"name": ["b"]})
