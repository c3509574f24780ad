"""Files of predictions, read and written, give the numbers that the same predictions give in memory."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from saunet.errors import DataError
from saunet.evaluation import score as score_all
from saunet.evaluation.predictors import ExportingPredictor, FilePredictor, PredictorNetwork, file_stem
from saunet.io.images import read_depth
from saunet.metrics.protocols import protocol
from saunet.prediction.prediction import ImagePredictor

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
    return score_all({"m": predictor}, batches(), [protocol("metric")], progress=False).errors("m", "metric")


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
    np.testing.assert_array_equal(score(FilePredictor(tmp_path / "disps.npy", NAMES)), in_memory())


def test_array_of_depths(tmp_path):
    np.save(tmp_path / "depth.npy", 1 / DISPARITY.astype(np.float64))
    np.testing.assert_allclose(score(FilePredictor(tmp_path / "depth.npy", NAMES, "depth")), in_memory(), rtol=1e-5)


def test_reference_array_gives_the_published_loop(tmp_path, reference):
    data = reference("metrics")
    np.save(tmp_path / "disps.npy", data["eigen_disparity"])
    truth = torch.from_numpy(data["eigen_gt"])[:, None]
    batch = {"name": ["a", "b"], "target": None, "depth": truth, "depth_size": torch.tensor([[375, 1242]] * 2)}
    result = score_all(
        {"m": FilePredictor(tmp_path / "disps.npy", ["a", "b"])}, [batch], [protocol("eigen_camera_z")], progress=False
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
    found = score(FilePredictor(tmp_path, NAMES, "disparity" if kind == "npy" else "depth", match))
    np.testing.assert_allclose(
        found, in_memory(), **({"atol": 0.0} if kind == "npy" else {"rtol": 0.01, "atol": 0.005})
    )


def test_png_of_disparity_is_read_as_disparity(tmp_path):
    """A perfect predictor that writes pixels of disparity x 256, as KITTI's stereo benchmark does."""
    depth = np.linspace(4, 40, 240, dtype=np.float32).reshape(12, 20)
    cv2.imwrite(str(tmp_path / "0.png"), np.round(256 * 400 / depth).astype(np.uint16))
    batch = {"name": ["a"], "target": None, "depth": torch.from_numpy(depth)[None, None]}
    batch["depth_size"] = torch.tensor([[12, 20]])
    predictor = FilePredictor(tmp_path, ["a"], "disparity")
    result = score_all({"m": predictor}, [batch], [protocol("eigen_camera_z")], progress=False)
    assert result.summaries()[0].errors[0] < 1e-3


def test_an_array_may_hold_images_that_are_not_evaluated_and_in_another_order(tmp_path):
    order = [NAMES[3], "no truth", *NAMES[:3], NAMES[4]]
    array = np.stack([DISPARITY[3], np.full((6, 10), 9.0), *DISPARITY[:3], DISPARITY[4]]).astype(np.float32)
    np.save(tmp_path / "disps.npy", array)
    np.testing.assert_array_equal(score(FilePredictor(tmp_path / "disps.npy", order)), in_memory())


def test_a_path_says_what_it_is(tmp_path):
    np.save(tmp_path / "disps.npy", DISPARITY)
    array = FilePredictor(tmp_path / "disps.npy", NAMES)
    assert array.values == "disparity"
    (tmp_path / "depth").mkdir()
    for name, disparity in zip(NAMES, DISPARITY, strict=True):
        np.save(tmp_path / "depth" / f"{file_stem(name)}.npy", 1 / disparity)
    np.testing.assert_allclose(score(FilePredictor(tmp_path / "depth", match="name")), in_memory(), rtol=1e-5)
    with pytest.raises(DataError, match="no predictions at"):
        FilePredictor(tmp_path / "nothing", NAMES)


def test_file_stem():
    assert file_stem("2011_09_26/drive_0001_sync 0000000005 l") == "2011_09_26_drive_0001_sync_0000000005_l"


def test_wrong_count(tmp_path):
    np.save(tmp_path / "disps.npy", DISPARITY)
    with pytest.raises(DataError, match="holds 5 predictions for 6 images"):
        FilePredictor(tmp_path / "disps.npy", [*NAMES, "one more"])
    with pytest.raises(DataError, match=f"no prediction for image '{NAMES[0]}'; it belongs to another split"):
        score(FilePredictor(tmp_path / "disps.npy", [f"other {i}" for i in range(5)]))
    (tmp_path / "folder").mkdir()
    np.save(tmp_path / "folder" / "0.npy", DISPARITY[0])
    with pytest.raises(DataError, match="holds 1 predictions for 2 images"):
        FilePredictor(tmp_path / "folder", NAMES[:2], match="order")
    with pytest.raises(DataError, match=r"has no file 'day_drive_0_0000000000_l\.npy'"):
        score(FilePredictor(tmp_path / "folder", match="name"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not numpy", "as a numpy array"),
        (np.zeros((5, 6), np.float32), r"holds shape \(5, 6\)"),
        (np.zeros((5, 6, 10), np.uint8), "does not contain floating-point numbers"),
    ],
)
def test_broken_arrays(tmp_path, content, message):
    path = tmp_path / "disps.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    with pytest.raises(DataError, match=message):
        FilePredictor(path, NAMES)


def read_all(folder):
    names = NAMES[: len(list(folder.iterdir()))]
    return FilePredictor(folder, names, match="order")({"name": names})


def test_broken_files_of_a_folder(tmp_path):
    with pytest.raises(DataError, match="no predictions at"):
        FilePredictor(tmp_path / "missing")
    with pytest.raises(DataError, match="holds no prediction"):
        FilePredictor(tmp_path)
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
    with pytest.raises(DataError, match="pixels without valid depth"):
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


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_disparity_that_is_nowhere_positive_is_no_prediction(tmp_path, value):
    maps = np.full((2, 3, 4), value, np.float32)
    maps[0, 1, 1] = 0.5  # some pixels that are infinitely far away are normal
    np.save(tmp_path / "disps.npy", maps)
    predict = FilePredictor(tmp_path / "disps.npy", ["a", "b"])
    assert predict({"name": ["a"]}).max() == 0.5
    with pytest.raises(DataError, match=r"disps.npy' has an image without disparity above 0"):
        predict({"name": ["b"]})


def export_batch():
    generator = torch.Generator().manual_seed(0)
    depth = torch.rand(3, 1, 24, 40, generator=generator) * 60 + 2
    depth[2] = 0
    return {
        "target": torch.zeros(3, 3, 8, 16),
        "name": ["day/a 0 l", "day/b 1 l", "day/c 2 l"],
        "depth": depth,
        "depth_size": torch.tensor([[24, 40], [20, 36], [24, 40]]),
    }


def disparity_of(batch):
    return torch.rand(3, 1, 8, 16, generator=torch.Generator().manual_seed(1)) * 0.2 + 0.02


def test_scaled_by_the_median_at_native_size_and_only_where_there_is_truth(tmp_path):
    rules = protocol("eigen_improved")
    exporting = ExportingPredictor(disparity_of, tmp_path, rules)
    first = score_all({"m": exporting}, [export_batch()], [rules], ground_truth="improved", progress=False)
    assert exporting.written == 2
    assert str(exporting).startswith(
        "export: 2 images, scaled as in 'eigen_improved', 1 left out because they have no ground"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["day_a_0_l.png", "day_b_1_l.png"]
    assert read_depth(tmp_path / "day_b_1_l.png").shape == (20, 36)
    for place in range(2):
        one = {key: value[place : place + 1] for key, value in export_batch().items()}
        again = score_all(
            {"m": FilePredictor(tmp_path, match="name")}, [one], [rules], ground_truth="improved", progress=False
        )
        np.testing.assert_allclose(again.rows[0].errors, first.rows[place].errors, rtol=5e-3, atol=2e-3)
        assert abs(again.rows[0].scale - 1) < 1e-3


def test_meters_as_predicted_also_without_truth(tmp_path):
    without = {key: value for key, value in export_batch().items() if not key.startswith("depth")}
    ExportingPredictor(lambda _: torch.full((3, 1, 8, 16), 0.1), tmp_path, protocol("metric"))(without)
    stored = read_depth(tmp_path / "day_c_2_l.png")
    assert stored.shape == (8, 16)
    assert np.unique(stored).tolist() == [10.0]


def test_a_predictor_of_another_size_sees_images_at_its_own() -> None:
    class OfSize(ImagePredictor):
        def __init__(self) -> None:
            super().__init__(32, 64)
            self.seen: list[tuple[int, ...]] = []

        def disparity(self, images):
            self.seen.append(images.shape)
            return images.mean(1) + 0.1

        @property
        def fingerprint(self) -> str:
            return ""

    predictor = OfSize()
    image = torch.rand(2, 3, 64, 192, generator=torch.Generator().manual_seed(0))
    disparity = PredictorNetwork(predictor)(image)
    assert predictor.seen == [(2, 3, 32, 64)]
    assert disparity.shape == (2, 1, 32, 64)
    small = cv2.resize(image[0].permute(1, 2, 0).numpy(), (64, 32), interpolation=cv2.INTER_AREA).mean(2) + 0.1
    assert np.abs(disparity[0, 0].numpy() - small).mean() < 0.05, "smoothed as by a mean over areas, not picked"
    same = PredictorNetwork(predictor)(image[..., :32, :64])
    assert torch.allclose(same[:, 0], image[..., :32, :64].mean(1) + 0.1)
