"""Files of strangers: a result or a one-line error, in bounded memory, and nothing is executed."""

import ast
import json
import random
import resource
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from safetensors.torch import save

import evnlos
from evnlos import EvnlosError, open_dataset
from evnlos.config import to_dict
from evnlos.data import Sampling, read_capture, read_shard
from evnlos.models import Reconstructor, UNetConfig, Weights, load_weights, save_weights
from evnlos.training.settings import load_checkpoint, save_checkpoint

COUNTS = {"weights": 60, "checkpoint": 100, "shard": 120, "dataset": 50, "capture": 40}
ROOM = 1 << 30


@pytest.fixture
def bounded_memory() -> Iterator[None]:
    """Refuse the process more than a gigabyte above what it has: a header that is trusted fails here."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + ROOM, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.fixture(scope="module")
def network() -> Reconstructor:
    torch.manual_seed(0)
    return UNetConfig(width=8, depth=1, shuffle=1, rank=0).build("frame", Sampling())


@pytest.fixture
def loader(request, network, tiny_dataset, tiny_captures, tmp_path) -> tuple[list[Path], Callable[[], object]]:
    """Return the files of one kind, which a test may damage, and what reads them."""
    kind = request.param
    if kind == "weights":
        path = tmp_path / "weights.safetensors"
        save_weights(path, Weights(network, [], torch.zeros(4, 4)))
        return [path], lambda: load_weights(path)
    if kind == "checkpoint":
        path, optimiser = tmp_path / "checkpoint.safetensors", torch.optim.Adam(network.parameters())
        network(torch.ones(1, 1, 8, 8)).sum().backward()
        optimiser.step()
        save_checkpoint(path, network, optimiser, 1, [{"epoch": 1}], "key")
        return [path], lambda: load_checkpoint(path, network, optimiser, "key")
    if kind == "shard":
        path = tmp_path / "object.h5"
        shutil.copy(tiny_dataset.shard(tiny_dataset.objects()[0]), path)
        return [path], lambda: read_shard(path)
    if kind == "dataset":
        shutil.copy(tiny_dataset.folder / "dataset.yaml", tmp_path)
        return [tmp_path / "dataset.yaml"], lambda: open_dataset(tmp_path)
    folder = tmp_path / "capture"
    shutil.copytree(tiny_captures[0], folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return files, lambda: read_capture(folder)


def damaged(content: bytes, draw: random.Random) -> bytes:
    """Return content that was cut, shifted or flipped somewhere, most often near its start."""
    changed, how = bytearray(content), draw.random()
    place = draw.randrange(len(content))
    if how < 0.15:
        return content[:place]
    if how < 0.25:
        return content[:place] + content[place + draw.randrange(1, 64) :]
    if how < 0.35:
        return content[:place] + draw.randbytes(draw.randrange(1, 32)) + content[place:]
    reach = min(len(content), 8192) if how < 0.8 else len(content)
    for _ in range(draw.choice((1, 2, 4, 16))):
        place = draw.randrange(reach)
        changed[place] = draw.choice((changed[place] ^ (1 << draw.randrange(8)), 0, 255, draw.randrange(256)))
    return bytes(changed)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("loader", "count"), COUNTS.items(), ids=COUNTS, indirect=["loader"])
def test_damage_gives_a_result_or_one_line(loader, count: int, bounded_memory) -> None:
    files, read = loader
    whole = {path: path.read_bytes() for path in files}
    read()
    refused = 0
    for number in range(count):
        draw = random.Random(number)
        path = draw.choice(files)
        path.write_bytes(damaged(whole[path], draw))
        try:
            read()
        except EvnlosError as error:
            assert "\n" not in str(error), str(error)
            refused += 1
        path.write_bytes(whole[path])
    assert refused > count // 4


def shard_with(path: Path, change: Callable[[h5py.File], None], source: Path) -> None:
    shutil.copy(source, path)
    with h5py.File(path, "r+") as file:
        change(file)


def _huge(file: h5py.File) -> None:
    del file["frame"]
    file.create_dataset("frame", (10**6, 10**4, 10**4), np.float16, chunks=(1, 64, 64), compression="gzip")


def _bomb(file: h5py.File) -> None:
    """Zeros compress a thousandfold; a filter on top of a filter could do so again."""
    del file["surface"]
    file.create_dataset("surface", (1 << 18, 2, 64, 96), np.float16, chunks=(64, 2, 64, 96), compression="gzip")


def _virtual(file: h5py.File) -> None:
    del file["frame"]
    layout = h5py.VirtualLayout((8, 32, 48), np.float16)
    layout[:] = h5py.VirtualSource("secret.h5", "frame", (8, 32, 48))
    file.create_virtual_dataset("frame", layout)


def _external(file: h5py.File) -> None:
    del file["time_s"]
    file.create_dataset("time_s", (8,), np.float64, external=[("secret.bin", 0, 64)])


def _external_link(file: h5py.File) -> None:
    del file["frame"]
    file["frame"] = h5py.ExternalLink("secret.h5", "frame")


def _soft_link(file: h5py.File) -> None:
    del file["truth"]
    file["truth"] = h5py.SoftLink("/frame")


def _text(file: h5py.File) -> None:
    del file["time_s"]
    file["time_s"] = ["a"] * 8


def _other_size(file: h5py.File) -> None:
    del file["truth"]
    file["truth"] = np.zeros((8, 3, 5), np.float16)


def _fewer(file: h5py.File) -> None:
    del file["event_count"]
    file["event_count"] = np.zeros(5, np.int64)


@pytest.mark.parametrize(
    "change",
    [_huge, _bomb, _virtual, _external, _external_link, _soft_link, _text, _other_size, _fewer],
    ids=lambda change: change.__name__,
)
def test_a_hostile_shard_reads_no_other_file_and_takes_no_memory(
    change, tiny_dataset, tmp_path, bounded_memory, monkeypatch
) -> None:
    source = tiny_dataset.shard(tiny_dataset.objects()[0])
    monkeypatch.chdir(tmp_path)
    shutil.copy(source, tmp_path / "secret.h5")
    (tmp_path / "secret.bin").write_bytes(np.arange(8.0).tobytes())
    shard_with(tmp_path / "shard.h5", change, source)
    with pytest.raises(EvnlosError) as caught:
        read_shard(tmp_path / "shard.h5")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name", ["../x", "/etc/passwd", "a/b", "a\\b", "C:x", ".x", "..", "", "a\0b", "a\nb", 7, ["x"]]
)
def test_an_object_is_a_file_of_its_dataset(name, tiny_dataset, tmp_path) -> None:
    from evnlos.config import read_yaml, save_yaml

    values = read_yaml(tiny_dataset.folder / "dataset.yaml")
    values["split"]["train"][0] = name
    save_yaml(values, tmp_path / "dataset.yaml")
    with pytest.raises(EvnlosError, match="name"):
        open_dataset(tmp_path)


def test_a_capture_names_files_of_its_own_folder_only(tiny_captures, tmp_path) -> None:
    shutil.copy(next(tiny_captures[0].glob("events*")), tmp_path / "outside.raw")
    for number, name in enumerate(("../outside.raw", str(tmp_path / "outside.raw"), "link.raw")):
        folder = tmp_path / str(number)
        shutil.copytree(tiny_captures[0], folder)
        (folder / "link.raw").symlink_to(tmp_path / "outside.raw")
        page = folder / "capture.yaml"
        lines = [line for line in page.read_text().splitlines() if not line.startswith("events:")]
        page.write_text("\n".join([*lines, f"events: {name}"]))
        with pytest.raises(EvnlosError, match="outside the capture folder"):
            read_capture(folder)


ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 9)
)
PAGE = "origin: simulation\nversion: '1'\n"


@pytest.mark.parametrize(
    "text",
    [
        ALIASES + PAGE + "split: {}\nsampling: {height: *a8}\n",
        ALIASES + PAGE + "sampling: {}\nsplit: {train: *a8}\n",
        PAGE + "sampling: {}\nsplit: " + "{a: " * 3000 + "1" + "}" * 3000,
    ],
    ids=["aliases", "aliases in the split", "depth"],
)
def test_a_page_that_unfolds_is_refused(text: str, tmp_path, bounded_memory) -> None:
    (tmp_path / "dataset.yaml").write_text(text)
    with pytest.raises(EvnlosError, match="valid YAML"):
        open_dataset(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"network": {"width": 8, "depth": 1, "shuffle": 100_000}},
        {"network": {"width": 100_000, "depth": 1, "shuffle": 1}},
        {"network": {"width": 64, "depth": 16, "blocks": 64, "shuffle": 1}},
        {"network": [1]},
        {"network": None},
        {"modality": ["frame"]},
        {"history": 5},
        {"history": [1]},
        {"sampling": "none"},
        {"format": None},
    ],
    ids=str,
)
def test_weights_that_claim_too_much_are_refused(change, network, tmp_path, bounded_memory) -> None:
    path = tmp_path / "w.safetensors"
    about = {"format": "evnlos-weights-4", "modality": "frame", "network": to_dict(network.settings)}
    about |= {"sampling": to_dict(Sampling())}
    tensors = dict(network.state_dict()) | {"wide": torch.zeros(200_000)}
    if "network" not in change:
        del tensors["wide"]
    path.write_bytes(save(tensors, metadata={"evnlos": json.dumps(about | change)}))
    with pytest.raises(EvnlosError) as caught:
        load_weights(path)
    assert "\n" not in str(caught.value)
    if "network" not in change:
        path.write_bytes(save(tensors, metadata={"evnlos": json.dumps(about)}))
        assert load_weights(path).modality.name == "frame"


@pytest.mark.parametrize("text", ["[" * 100_000, "[1]", "1", "{}"], ids=["deep", "list", "number", "empty"])
def test_weights_that_describe_nothing_are_refused(text: str, network, tmp_path) -> None:
    path = tmp_path / "w.safetensors"
    path.write_bytes(save(network.state_dict(), metadata={"evnlos": text}))
    with pytest.raises(EvnlosError):
        load_weights(path)


def test_a_table_of_frames_that_names_no_file_is_refused(tiny_captures, tmp_path) -> None:
    for number, name in enumerate(("a" * 5000 + ".png", "a\0b.png", "caf\xff.png")):
        folder = tmp_path / str(number)
        shutil.copytree(tiny_captures[0], folder)
        (folder / "frames.csv").write_bytes(f"t_us,file\n0,{name}\n".encode("latin-1"))
        with pytest.raises(EvnlosError):
            read_capture(folder)


def test_a_checkpoint_of_other_tensors_is_refused(network, tmp_path) -> None:
    optimiser = torch.optim.Adam(network.parameters())
    state = {f"network.{name}": value for name, value in network.state_dict().items()}
    about = {"evnlos": '{"epoch": 1, "log": [], "key": "k"}'}
    path = tmp_path / "c.safetensors"
    for strange in (
        {"optimiser.0.exp_avg": torch.zeros(3)},
        {"optimiser.9999.exp_avg": torch.zeros(3)},
        {"optimiser.x": torch.zeros(3)},
        {"network.unet.stem.weight": torch.zeros(1)},
    ):
        path.write_bytes(save(state | strange, metadata=about))
        with pytest.raises(EvnlosError, match="delete it to start afresh"):
            load_checkpoint(path, network, optimiser, "k")
    for text in (
        "[" * 100_000,
        "[]",
        '{"epoch": "x", "log": [], "key": "k"}',
        '{"epoch": 1, "log": 5, "key": "k"}',
    ):
        path.write_bytes(save(state, metadata={"evnlos": text}))
        with pytest.raises(EvnlosError, match="delete it to start afresh"):
            load_checkpoint(path, network, optimiser, "k")


def test_nothing_is_unpickled() -> None:
    """A pickle can run any program; so can YAML with tags, and evaluated text."""
    root = Path(evnlos.__file__).parent
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                names = [alias.name for alias in node.names] + [getattr(node, "module", "") or ""]
                assert not {name.split(".")[0] for name in names} & {"pickle", "dill", "shelve", "joblib"}, path
            if not isinstance(node, ast.Call):
                continue
            call, given = ast.unparse(node.func), {word.arg: ast.unparse(word.value) for word in node.keywords}
            assert call not in ("eval", "exec", "yaml.unsafe_load", "yaml.full_load"), path
            if call == "torch.load":
                assert given.get("weights_only") == "True", path
            if call == "np.load":
                assert given.get("allow_pickle") == "False", path
            if call == "yaml.load":
                assert ast.unparse(node.args[1]).endswith("Loader"), path
