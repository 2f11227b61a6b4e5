"""Images beside numbers: learned from as bytes, encoded once, and seen alike in data, environments and exported files."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import DatasetError, load_dataset
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.policies.images import EXTRACTORS, N_CROPS, ImageEncoder, ResidualExtractor, spatial_softmax
from sb3_dtfm.policies.resnet import GroupNorm
from tests.algorithms.small import make_model
from tests.images import CAMERA, make_pixels, record

DEPLOY = Path(__file__).parents[2] / "examples" / "deploy.py"
SMALL = dict(features_extractor_kwargs=dict(channels=(8, 8, 8), features_dim=8))
BOUNDS = dict(action_bounds=(-2, 2))


@pytest.fixture(scope="module")
def episodes():
    pytest.importorskip("pygame")
    return record(4)


@pytest.fixture(scope="module")
def buffer(episodes):
    return load_dataset(episodes, **BOUNDS)


def make(algorithm, buffer, **kwargs):
    policy_kwargs = {**SMALL, **kwargs.pop("policy_kwargs", {})}
    return make_model(algorithm, buffer, context_length=3, policy_kwargs=policy_kwargs, **kwargs)


def wrapped():
    return ReturnToGoWrapper(make_pixels(), target_return=-100.0)


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_a_model_of_images_learns_acts_and_comes_back(algorithm, buffer, tmp_path):
    model = make(algorithm, buffer, ema_decay=0.9).learn(3)
    env = make_vec_env(wrapped, 2)
    model.set_env(env)
    observation = model.get_env().reset()
    assert observation[CAMERA].shape == (2, 3, 32, 32), "channels first, by SB3"
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env)
    actions = [each.predict(observation, deterministic=True)[0] for each in (model, loaded)]
    np.testing.assert_array_equal(*actions)
    returns, _ = evaluate_policy(loaded, env, 2, deterministic=True, return_episode_rewards=True)
    assert np.isfinite(returns).all()


def test_the_picture_decides_and_its_channels_may_come_first_or_last(buffer):
    model = make(DTFM, buffer, policy_kwargs=dict(regression_coef=1.0, flow_steps=0)).learn(2)
    observation, _ = wrapped().reset(seed=0)
    seen = model.policy.predict(observation, deterministic=True)[0]
    first = {**observation, CAMERA: np.moveaxis(observation[CAMERA], 2, 0)}
    model.policy.reset()
    np.testing.assert_array_equal(model.policy.predict(first, deterministic=True)[0], seen)
    model.policy.reset()
    black = {**observation, CAMERA: np.zeros_like(observation[CAMERA])}
    assert not np.array_equal(model.policy.predict(black, deterministic=True)[0], seen)


def test_a_frame_is_encoded_once(buffer, monkeypatch):
    """The context holds its features."""
    model = make(DT, buffer)
    env, n_frames = wrapped(), []
    encoder = model.policy.acting_network.encoder
    forward = encoder.forward
    monkeypatch.setattr(encoder, "forward", lambda images: n_frames.append(len(images[CAMERA])) or forward(images))
    observation, _ = env.reset(seed=0)
    state, start = None, np.array([True])
    for _ in range(5):
        action, state = model.policy.predict(observation, state, start, deterministic=True)
        observation, *_ = env.step(action)
        start = np.array([False])
    assert n_frames == [1] * 5
    assert state.observations.shape == (1, 3, 3 + 8)
    assert not any(array.dtype == np.uint8 for array in state)


def test_windows_hold_the_bytes_of_each_step(buffer, episodes):
    batch = buffer.windows(th.tensor([0, 25]), 3)
    images = batch.observations[CAMERA]
    assert (images.shape, images.dtype) == ((2, 3, 3, 32, 32), th.uint8)
    for back in range(3):
        recorded = np.moveaxis(episodes[1][5 - back][0][CAMERA], 2, 0)
        np.testing.assert_array_equal(images[1, -1 - back].numpy(), recorded)
    assert buffer.own(CAMERA).shape == (80, 32, 32, 3), "each frame once"


def test_files_and_caches_hold_the_images(buffer, tmp_path):
    buffer.save(tmp_path / "pixels.npz")
    read = load_dataset(tmp_path / "pixels.npz")
    cached = load_dataset(tmp_path / "pixels.npz", cache_dir=tmp_path / "cache")
    for each in (read, cached, load_dataset([{"dataset": read}])):
        assert th.equal(each.own(CAMERA), buffer.own(CAMERA))
        assert each.image_spaces == buffer.image_spaces
    assert cached.memory_mapped
    half = buffer.select(np.array([2, 0]))
    assert th.equal(half.own(CAMERA)[:20], buffer.own(CAMERA)[40:60])


def test_images_alone_are_enough(tmp_path):
    pytest.importorskip("pygame")
    alone = load_dataset(record(2, numbers=False), **BOUNDS)
    model = DTFM("CnnPolicy", dataset=alone, batch_size=8, policy_kwargs=SMALL, seed=0).learn(2)
    env = ReturnToGoWrapper(make_pixels(numbers=False), target_return=-100.0)
    model.set_env(env)
    assert np.isfinite(model.predict(model.get_env().reset())[0]).all()


def test_sb3s_own_network_and_one_for_all_cameras(episodes, tmp_path):
    two = [[({**seen, "other": seen[CAMERA][:, ::-1]}, *rest) for seen, *rest in steps] for steps in episodes]
    for step in (step for steps in two for step in steps):
        step[0]["other"] = step[0]["other"].repeat(2, axis=0).repeat(2, axis=1)
        step[0][CAMERA] = step[0][CAMERA].repeat(2, axis=0).repeat(2, axis=1)  # NatureCNN needs 36 pixels
    data = load_dataset(two, **BOUNDS)
    kwargs = dict(features_extractor_class=NatureCNN, features_extractor_kwargs=dict(features_dim=16))
    model = make_model(DT, data, policy_kwargs=kwargs).learn(1)
    assert [type(each) for each in model.policy.network.encoder.extractors] == [NatureCNN, NatureCNN]
    model.save(tmp_path / "model")
    assert DT.load(tmp_path / "model").policy_kwargs == {**model.policy_kwargs, "features_extractor_class": "NatureCNN"}
    shared = make_model(DT, data, policy_kwargs={**kwargs, "share_features_extractor": True}).learn(1)
    assert len(shared.policy.network.encoder.extractors) == 1
    assert shared.policy.observation_dim == model.policy.observation_dim == 3 + 2 * 16


class Means(BaseFeaturesExtractor):
    """Mean colours, as a user's own class."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 3) -> None:
        super().__init__(observation_space, features_dim)
        self.linear = th.nn.Linear(observation_space.shape[0], features_dim)

    def forward(self, images: th.Tensor) -> th.Tensor:
        return self.linear(images.mean(dim=(2, 3)))


def test_a_class_of_a_users_own_is_given_as_sb3_takes_it_and_comes_back_by_its_name(buffer, tmp_path):
    kwargs = dict(features_extractor_class=Means, features_extractor_kwargs=dict(features_dim=4))
    try:
        model = make_model(DT, buffer, policy_kwargs=kwargs).learn(1)
        model.save(tmp_path / "model")
        loaded = DT.load(tmp_path / "model")
        observation, _ = wrapped().reset(seed=0)
        np.testing.assert_array_equal(*(each.predict(observation, deterministic=True)[0] for each in (model, loaded)))
        again = DT.load(tmp_path / "model", policy_kwargs={**loaded.policy_kwargs, "features_extractor_class": Means})
        assert again.policy_kwargs["features_extractor_class"] == "Means"
    finally:
        EXTRACTORS.pop("Means", None)
    with pytest.raises(ValueError, match=r"features_extractor_class must be one of .*EXTRACTORS by its name, got 'Means'"):
        DT.load(tmp_path / "model")
    kwargs["features_extractor_kwargs"] = dict(activation=th.nn.Tanh)
    with pytest.raises(
        ValueError,
        match="features_extractor_kwargs: it holds a type, not plain values; a model's file holds numbers, text, lists and",
    ):
        make_model(DT, buffer, policy_kwargs=kwargs)
    EXTRACTORS.pop("Means", None)
    named_alike = type("NatureCNN", (Means,), {})
    with pytest.raises(ValueError, match="NatureCNN is the name of a packaged class; call yours something else"):
        make_model(DT, buffer, policy_kwargs=dict(features_extractor_class=named_alike))
    with pytest.raises(ValueError, match="Linear is no subclass of SB3's BaseFeaturesExtractor"):
        make_model(DT, buffer, policy_kwargs=dict(features_extractor_class=th.nn.Linear))


def test_torchvisions_resnet_takes_weights_of_a_file(buffer, tmp_path):
    models = pytest.importorskip("torchvision.models")
    published = models.resnet18()
    th.save(published.state_dict(), tmp_path / "resnet18.pth")
    kwargs = dict(features_dim=8, weights=str(tmp_path / "resnet18.pth"))
    model = make_model(DT, buffer, policy_kwargs=dict(features_extractor_class="ResNet18", features_extractor_kwargs=kwargs))
    first = model.policy.network.encoder.extractors[0].network.conv1.weight
    assert th.equal(first, published.conv1.weight)
    model.learn(1).save(tmp_path / "model")
    (tmp_path / "resnet18.pth").unlink()
    loaded = DT.load(tmp_path / "model")
    assert loaded.policy_kwargs["features_extractor_kwargs"] == dict(features_dim=8)
    assert th.equal(loaded.policy.network.encoder.extractors[0].network.conv1.weight, first)
    observation, _ = wrapped().reset(seed=0)
    np.testing.assert_array_equal(*(each.predict(observation, deterministic=True)[0] for each in (model, loaded)))
    th.save(dict(other=th.zeros(1)), tmp_path / "resnet18.pth")
    with pytest.raises(ValueError, match=r"resnet18\.pth holds no weights of ResNet-18: conv1\.weight is missing"):
        make_model(DT, buffer, policy_kwargs=dict(features_extractor_class="ResNet18", features_extractor_kwargs=kwargs))


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("raise ModuleNotFoundError('No module named torchvision')", "ResNet18 needs torchvision: pip install torchvision"),
        (
            "raise RuntimeError('operator torchvision::nms does not exist')",
            r"built for torch .*fails: operator torchvision::nms does not exist. Install both from the same package index",
        ),
    ],
)
def test_a_torchvision_that_is_missing_or_does_not_fit_is_told_of(code, told, tmp_path, monkeypatch):
    (tmp_path / "torchvision").mkdir()
    (tmp_path / "torchvision" / "__init__.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    for name in [each for each in sys.modules if each.partition(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(ImportError, match=told):
        encoder("ResNet18", {"camera": (3, 32, 32)})


def test_a_critic_values_what_images_show(buffer):
    model = make(DTFM, buffer, policy_kwargs=dict(critic_steps=1, n_action_samples=2)).learn(2)
    observation, _ = wrapped().reset(seed=0)
    assert np.isfinite(model.policy.predict(observation, deterministic=True)[0]).all()


@pytest.mark.parametrize("acting", [{}, dict(chunk_size=4, n_action_steps=2), dict(kv_cache=True)])
def test_the_exported_file_acts_alike(buffer, acting, tmp_path):
    """By the example's loop, as a user would take it."""
    pytest.importorskip("onnxruntime")
    model = make(DTFM, buffer, policy_kwargs=dict(acting, n_layers=1, flow_steps=2)).learn(2)
    model.export(tmp_path / "policy.onnx")
    policy = runpy.run_path(str(DEPLOY))["Policy"](str(tmp_path / "policy.onnx"))
    assert policy.settings["images"] == {CAMERA: [3, 32, 32]}
    for wrong in (np.zeros((32, 32, 3)), np.zeros((32, 32, 1), np.uint8)):
        with pytest.raises(ValueError, match=r"pixels: expected uint8 of \[3, 32, 32\], channels first or last; got"):
            policy.act(np.zeros(3), -100.0, 0, {CAMERA: wrong})
    env = DummyVecEnv([wrapped])
    env.seed(0)
    observation, state, start = env.reset(), None, np.array([True])
    for timestep in range(5):
        seen = {name: values[0] for name, values in observation.items()}
        acted = policy.act(seen["observation"], seen["return_to_go"].item(), timestep, {CAMERA: seen[CAMERA]})
        action, state = model.policy.predict(observation, state, start, deterministic=True)
        np.testing.assert_allclose(acted, action[0], atol=1e-4)
        observation, *_ = env.step(action)
        start = np.array([False])


@pytest.mark.parametrize("name", ["mask", "chunk"])
def test_an_image_with_the_name_of_an_input_or_output_is_refused_by_the_export(name, episodes, tmp_path):
    pytest.importorskip("onnxruntime")
    named = [({name: seen[CAMERA], "state": seen["state"]}, *rest) for seen, *rest in episodes[0]]
    model = make(DT, load_dataset([named], **BOUNDS)).learn(1)
    with pytest.raises(
        ValueError, match=f"export: an image is called {name}, which the file calls something else; rename it"
    ):
        model.export(tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()


def test_training_crops_at_random_and_acting_in_the_centre():
    extractor = ResidualExtractor(spaces.Box(0, 255, (3, 40, 60), np.uint8), crop=0.5)
    images = th.arange(40 * 60).view(1, 1, 40, 60).expand(64, 3, -1, -1).float()
    centre = extractor.eval()._crop(images)
    assert th.equal(centre[0, 0], images[0, 0, 10:30, 15:45])
    for n_images in (N_CROPS, 64):  # by indices, and by slices that some images share
        crops = extractor.train()._crop(images[:n_images])
        assert crops.shape == (n_images, 3, 20, 30)
        assert len({float(each[0, 0, 0]) for each in crops}) > 10
        assert th.equal(crops - crops[:, :, :1, :1], (centre - centre[:, :, :1, :1])[:n_images])


def test_training_shifts_at_random_and_acting_does_not():
    extractor = ResidualExtractor(spaces.Box(0, 255, (3, 30, 40), np.uint8), crop=1.0, shift=4)
    images = th.arange(1.0, 31.0).view(1, 1, 30, 1).expand(32, 3, 30, 40)  # each row its number
    assert th.equal(extractor.eval()._crop(images), images)
    shifted = extractor.train()._crop(images)
    assert shifted.shape == images.shape
    middle = shifted[:, 0, 15, 20] - 16.0
    assert set(middle.tolist()) <= set(range(-4, 5))
    assert len(set(middle.tolist())) > 3
    assert shifted.min() == 1.0, "edges are repeated, not black"
    assert shifted.max() == 30.0
    with pytest.raises(ValueError, match="shift must be a number of pixels, 0 or more, got -1"):
        ResidualExtractor(spaces.Box(0, 255, (3, 30, 40), np.uint8), shift=-1)


def test_spatial_softmax_finds_the_place():
    maps = th.zeros(1, 2, 5, 9)
    maps[0, 0, 0, 8] = maps[0, 1, 2, 4] = 100.0
    th.testing.assert_close(spatial_softmax(maps), th.tensor([[-1.0, 0.0, 1.0, 0.0]]))


@pytest.mark.parametrize("layout", [th.contiguous_format, th.channels_last])
def test_spatial_softmax_is_the_mean_position(layout):
    maps = th.randn(2, 3, 4, 5, generator=th.Generator().manual_seed(0)).contiguous(memory_format=layout)
    weights = maps.reshape(2, 3, 20).softmax(dim=2).view(2, 3, 4, 5)
    rows, columns = th.meshgrid(th.linspace(-1, 1, 4), th.linspace(-1, 1, 5), indexing="ij")
    expected = [(weights * place).sum(dim=(2, 3)) for place in (rows, columns)]
    found = spatial_softmax(maps.requires_grad_())
    th.testing.assert_close(found, th.cat(expected, dim=1))
    found.square().sum().backward()
    if layout == th.channels_last:
        assert maps.grad.is_contiguous(memory_format=layout), "gradients need no copy"


def test_images_of_bfloat16_are_normalised_in_float32_and_stay_in_their_layout(monkeypatch):
    seen, kernel = [], th.nn.functional.group_norm
    monkeypatch.setattr(th.nn.functional, "group_norm", lambda maps, *rest: seen.append(maps.dtype) or kernel(maps, *rest))
    norm, maps = GroupNorm(2, 4), th.randn(3, 4, 5, 6, generator=th.Generator().manual_seed(0))
    low = maps.bfloat16().contiguous(memory_format=th.channels_last)
    found = norm(low)
    assert (seen, found.dtype) == ([th.float32], th.bfloat16)
    assert found.is_contiguous(memory_format=th.channels_last)
    th.testing.assert_close(found, kernel(low.float(), 2).bfloat16())
    assert norm.double()(maps.double()).dtype == th.float64


def encoder(class_name, shapes, kwargs=None, normalize_images=True, shared=False):
    images = {camera: spaces.Box(0, 255, shape, np.uint8) for camera, shape in shapes.items()}
    return ImageEncoder(images, class_name, kwargs or {}, normalize_images, shared)


@pytest.mark.parametrize(("normalize_images", "largest"), [(True, 1.0), (False, 255.0)])
def test_each_camera_reaches_its_own_extractor_divided_by_255_or_not(normalize_images, largest, monkeypatch):
    monkeypatch.setitem(EXTRACTORS, "Means", Means)
    made, seen = encoder("Means", dict.fromkeys("ab", (3, 4, 5)), normalize_images=normalize_images), {}
    for camera, extractor in zip("ab", made.extractors, strict=True):
        extractor.register_forward_pre_hook(lambda _, images, camera=camera: seen.update({camera: images[0]}))
    dark, bright = th.zeros(2, 3, 4, 5, dtype=th.uint8), th.full((2, 3, 4, 5), 255, dtype=th.uint8)
    assert made({"a": dark, "b": bright}).shape == (2, 6)
    assert (seen["a"] == 0.0).all()
    assert (seen["b"] == largest).all()


def test_the_default_crops_nine_tenths():
    for side, left in ((84, 76), (96, 86), (224, 202)):
        assert ResidualExtractor(spaces.Box(0, 255, (3, side, side), np.uint8)).size == (left, left)


@pytest.mark.parametrize(("side", "channels"), [(12, (32, 64, 64)), (18, (32, 64, 64, 64))])
def test_images_too_small_for_a_place_to_differ_are_refused(side, channels):
    def space(width):
        return spaces.Box(0, 255, (3, side, width), np.uint8)

    with pytest.raises(ValueError, match=f"of images of {side} x {side} a map of 1 x 1 is left, in which no place differs"):
        ResidualExtractor(space(side), channels=channels)
    wider = ResidualExtractor(space(side + 6), channels=channels).eval()
    maps = wider.blocks(th.relu(wider.stem(wider._crop(th.rand(1, 3, side, side + 6)))))
    assert tuple(maps.shape[2:]) == (1, 2)


def test_extractors_that_cannot_be_made_are_told_of_with_the_camera(episodes, buffer):
    shapes = {"top": (3, 20, 20)}
    for class_name, kwargs, message in (
        (
            "ResidualExtractor",
            dict(cnn_output_dim=16),
            r"ResidualExtractor\(cnn_output_dim=16\) cannot be .* 'top'.*unexpected",
        ),
        ("NatureCNN", {}, r"NatureCNN\(\) cannot be made for the camera 'top', whose images have the shape \(3, 20, 20\)"),
        ("ResidualExtractor", dict(channels=(8, 8, 8, 8, 8)), "a map of 1 x 1 is left"),
    ):
        with pytest.raises(ValueError, match=message):
            encoder(class_name, shapes, kwargs)
    with pytest.raises(ValueError, match="ResNet18 expects images from 0 to 1: leave normalize_images=True"):
        encoder("ResNet18", shapes, normalize_images=False)
    with pytest.raises(
        ValueError, match=r"share_features_extractor=True needs images of one shape, got \[\(3, 20, 20\), \(3"
    ):
        encoder("ResidualExtractor", {**shapes, "hand": (3, 30, 30)}, shared=True)
    with pytest.raises(
        ValueError, match="CombinedExtractor takes a Dict; expected is a class that takes one camera's image"
    ):
        make(DT, buffer, policy_kwargs=dict(features_extractor_class=CombinedExtractor))
    assert encoder("ResidualExtractor", shapes, dict(channels=(4, 4))).features_dim == 64


def test_images_with_reversed_axes_and_a_state_that_stays_as_it_was(buffer):
    model = make(DT, buffer)
    observation, _ = wrapped().reset(seed=0)
    _, state = model.policy.predict(observation, deterministic=True)
    before = [np.array(part) for part in state]
    model.policy.reset()
    reversed_channels = {**observation, CAMERA: observation[CAMERA][..., ::-1]}
    copied = {**observation, CAMERA: observation[CAMERA][..., ::-1].copy()}
    actions = [
        model.policy.predict(seen, state, np.array([False]), deterministic=True)[0] for seen in (reversed_channels, copied)
    ]
    np.testing.assert_array_equal(*actions)
    for part, kept in zip(state, before, strict=True):
        np.testing.assert_array_equal(part, kept)


def change(episodes, make_image):
    return [[({**seen, CAMERA: make_image(seen[CAMERA])}, *rest) for seen, *rest in steps] for steps in episodes]


def test_unfit_images_are_refused(episodes, buffer):
    with pytest.raises(DatasetError, match=r"float32 of shape \(20, 32, 32, 3\).*write \(255 \* images\)"):
        load_dataset(change(episodes, lambda image: image.astype(np.float32) / 255), **BOUNDS)
    with pytest.raises(
        DatasetError, match=r"episode 3: images of 'pixels' have shape \(16, 32, 3\), expected \(32, 32, 3\)"
    ):
        load_dataset([*episodes[:3], *change(episodes[3:], lambda image: image[::2])], **BOUNDS)
    mixed = [*episodes[0][:7], *change([episodes[0][7:]], lambda image: image[::2])[0]]
    with pytest.raises(
        DatasetError, match=r"pixels: step 7 has the shape \(16, 32, 3\), expected \(32, 32, 3\) as in step 0"
    ):
        load_dataset([mixed], **BOUNDS)
    arrays = {name: [np.asarray(seen[name]) for seen, *_ in mixed] for name in mixed[0][0]}
    others = {"actions": [action for _, action, *_ in mixed], "rewards": np.zeros(20)}
    with pytest.raises(
        DatasetError, match=r"pixels: step 7 has the shape \(16, 32, 3\), expected \(32, 32, 3\) as in step 0"
    ):
        load_dataset([{"observations": arrays, **others}], **BOUNDS)
    nested = [({"cameras": {CAMERA: seen[CAMERA]}, "state": seen["state"]}, *rest) for seen, *rest in episodes[0]]
    with pytest.raises(DatasetError, match=r"cameras, pixels holds images of shape \(32, 32, 3\) inside of another entry"):
        load_dataset([nested], **BOUNDS)
    stacked = [({CAMERA: np.stack([seen[CAMERA] / 255.0] * 4)}, *rest) for seen, *rest in episodes[0]]
    with pytest.raises(DatasetError, match=r"float64 of shape \(20, 4, 32, 32, 3\), expected images as uint8"):
        load_dataset([stacked], **BOUNDS)
    gray = [({CAMERA: seen[CAMERA].mean(axis=2) / 255.0}, *rest) for seen, *rest in episodes[0]]
    with pytest.warns(UserWarning, match=r"shape \(32, 32\) and becomes a vector of 1024 numbers"):
        load_dataset([gray], **BOUNDS)
    named = [({"actions": seen[CAMERA], "state": seen["state"]}, *rest) for seen, *rest in episodes[0]]
    with pytest.raises(DatasetError, match="An image is called actions; other names than action"):
        load_dataset([named], **BOUNDS)
    with pytest.raises(DatasetError, match="expected 1, 3 or 4 channels, either first or last"):
        load_dataset(change(episodes, lambda image: np.concatenate([image, image], axis=2)), **BOUNDS)
    with pytest.raises(DatasetError, match=r"images \{'pixels': \(3, 32, 32\)\}, the environment's are of no camera"):
        make(DT, buffer, env=ReturnToGoWrapper(record_env_without_images(), target_return=0.0))
    model = make(DT, buffer)
    observation, _ = wrapped().reset(seed=0)
    with pytest.raises(ValueError, match="no image 'pixels', which the model sees"):
        model.policy.predict({name: each for name, each in observation.items() if name != CAMERA})
    with pytest.raises(ValueError, match=r"uint8 of shape \(1, 16, 32, 3\); uint8 of \(1, 3, 32, 32\) or \(1, 32, 32, 3\)"):
        model.policy.predict({**observation, CAMERA: observation[CAMERA][::2]})
    with pytest.raises(ValueError, match=f"features_extractor_class must be one of {', '.join(EXTRACTORS)}"):
        make(DT, buffer, policy_kwargs=dict(features_extractor_class="ResNet"))


def record_env_without_images():
    import gymnasium as gym

    return gym.make("Pendulum-v1")
