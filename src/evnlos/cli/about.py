"""`evnlos cite`, `completion`, `fetch` and `verify`: what to quote, to type and to have, and what is whole.

- `evnlos cite`: BibTeX for exactly what a simulation, a dataset or a run uses.
- `evnlos completion`: a script that completes commands and flags.
- `evnlos fetch`: captures, weights and examples from an address or a folder, each file checked.
- `evnlos verify`: a dataset in, the list of its faulty shards out, mended if asked.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from evnlos.cli.parsing import check_there
from evnlos.config import read_yaml
from evnlos.errors import ConfigError, DataError, EvnlosError, printable
from evnlos.registry import __version__, migrate

ENTRIES = {
    "evnlos": f"""@software{{evnlos,
  title = {{evnlos: seeing moving objects around a corner with an event camera}},
  author = {{{{The evnlos developers}}}},
  version = {{{__version__}}}
}}""",
    "epnp": """@article{wang2024epnp,
  title = {Event-enhanced Passive Non-line-of-sight imaging for moving objects with Physical embedding},
  author = {Wang, Conghe and Wang, Xia and Fang, Yujie and Yan, Changda and Zhang, Xin and Zuo, Yifan},
  journal = {arXiv:2404.05977},
  year = {2024}
}""",
    "angular spectrum": """@article{matsushima2009bandlimited,
  title = {Band-Limited Angular Spectrum Method for Numerical Simulation of Free-Space Propagation in Far
           and Near Fields},
  author = {Matsushima, Kyoji and Shimobaba, Tomoyoshi},
  journal = {Optics Express},
  volume = {17}, number = {22}, pages = {19662--19673},
  year = {2009}
}""",
    "rough metal": """@inproceedings{walter2007microfacet,
  title = {Microfacet Models for Refraction through Rough Surfaces},
  author = {Walter, Bruce and Marschner, Stephen R. and Li, Hongsong and Torrance, Kenneth E.},
  booktitle = {Eurographics Symposium on Rendering},
  year = {2007}
}""",
    "event pixel": """@inproceedings{hu2021v2e,
  title = {v2e: From Video Frames to Realistic DVS Events},
  author = {Hu, Yuhuang and Liu, Shih-Chii and Delbruck, Tobi},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition Workshops},
  year = {2021}
}""",
    "time surface": """@article{lagorce2017hots,
  title = {{HOTS}: A Hierarchy of Event-Based Time-Surfaces for Pattern Recognition},
  author = {Lagorce, Xavier and Orchard, Garrick and Galluppi, Francesco and Shi, Bertram E. and
            Benosman, Ryad B.},
  journal = {IEEE Transactions on Pattern Analysis and Machine Intelligence},
  volume = {39}, number = {7}, pages = {1346--1359},
  year = {2017}
}""",
    "network": """@inproceedings{ronneberger2015unet,
  title = {U-Net: Convolutional Networks for Biomedical Image Segmentation},
  author = {Ronneberger, Olaf and Fischer, Philipp and Brox, Thomas},
  booktitle = {MICCAI},
  year = {2015}
}

@inproceedings{he2016identity,
  title = {Identity Mappings in Deep Residual Networks},
  author = {He, Kaiming and Zhang, Xiangyu and Ren, Shaoqing and Sun, Jian},
  booktitle = {ECCV},
  year = {2016}
}""",
    "optimiser": """@inproceedings{kingma2015adam,
  title = {Adam: A Method for Stochastic Optimization},
  author = {Kingma, Diederik P. and Ba, Jimmy},
  booktitle = {ICLR},
  year = {2015}
}""",
    "ssim": """@article{wang2004ssim,
  title = {Image Quality Assessment: From Error Visibility to Structural Similarity},
  author = {Wang, Zhou and Bovik, Alan C. and Sheikh, Hamid R. and Simoncelli, Eero P.},
  journal = {IEEE Transactions on Image Processing},
  volume = {13}, number = {4}, pages = {600--612},
  year = {2004}
}""",
    "haarpsi": """@article{reisenhofer2018haarpsi,
  title = {A {Haar} Wavelet-Based Perceptual Similarity Index for Image Quality Assessment},
  author = {Reisenhofer, Rafael and Bosse, Sebastian and Kutyniok, Gitta and Wiegand, Thomas},
  journal = {Signal Processing: Image Communication},
  volume = {61}, pages = {33--43},
  year = {2018}
}""",
    "gmsd": """@article{xue2014gmsd,
  title = {Gradient Magnitude Similarity Deviation: A Highly Efficient Perceptual Image Quality Index},
  author = {Xue, Wufeng and Zhang, Lei and Mou, Xuanqin and Bovik, Alan C.},
  journal = {IEEE Transactions on Image Processing},
  volume = {23}, number = {2}, pages = {684--695},
  year = {2014}
}""",
    "lpips": """@inproceedings{zhang2018lpips,
  title = {The Unreasonable Effectiveness of Deep Features as a Perceptual Metric},
  author = {Zhang, Richard and Isola, Phillip and Efros, Alexei A. and Shechtman, Eli and Wang, Oliver},
  booktitle = {CVPR},
  year = {2018}
}""",
    "total variation": """@article{chambolle2011primaldual,
  title = {A First-Order Primal-Dual Algorithm for Convex Problems with Applications to Imaging},
  author = {Chambolle, Antonin and Pock, Thomas},
  journal = {Journal of Mathematical Imaging and Vision},
  volume = {40}, number = {1}, pages = {120--145},
  year = {2011}
}""",
    "photograph": """@article{saunders2019periscopy,
  title = {Computational Periscopy with an Ordinary Digital Camera},
  author = {Saunders, Charles and Murray-Bruce, John and Goyal, Vivek K.},
  journal = {Nature},
  volume = {565}, pages = {472--475},
  year = {2019}
}""",
}  # fmt: skip
"""BibTeX entries by what they are for."""


def entries_for(path: str | Path | None = None) -> dict[str, str]:
    """Return the entries for a settings file, a dataset's folder or a run's folder, by what they are for.

    Args:
        path: A simulation (YAML), a folder with `dataset.yaml` or `run.yaml`; None is everything.

    Raises:
        DataError: There is none of these.
    """
    if path is None:
        return dict(ENTRIES)
    path = Path(path)
    found = next((path / name for name in ("run.yaml", "dataset.yaml") if (path / name).is_file()), path)
    if not found.is_file():
        raise DataError(f"{path} is no settings file, dataset or run; give one, or none for every entry")
    values = read_yaml(found)
    wanted = {"evnlos", "epnp"}
    if found.name == "run.yaml":
        wanted |= {"network", "optimiser", "time surface", "ssim", "haarpsi", "gmsd", "lpips"}
    simulation = values.get("config", values) if isinstance(values.get("config", values), dict) else values
    wanted |= _of_simulation(simulation)
    return {name: text for name, text in ENTRIES.items() if name in wanted}


def _of_simulation(values: dict[str, Any]) -> set[str]:
    setup, wanted = migrate("Simulation", values).get("setup"), set()
    if isinstance(setup, dict):
        wanted.add("event pixel")
        kind = setup.get("kind", "paper")
        if kind == "paper":
            wanted.add("angular spectrum")
        elif kind == "radiometric" and setup.get("wall_material", "ggx") == "ggx":
            wanted.add("rough metal")
    if isinstance(values.get("sampling"), dict):
        wanted.add("time surface")
    return wanted


@dataclass(frozen=True)
class CiteCommand:
    """Print BibTeX for exactly what a settings file, a dataset or a run uses; for everything without one."""

    used: Annotated[Path | None, tyro.conf.Positional] = None
    """Settings file, dataset's folder or run's folder."""
    json: bool = False
    """Print one JSON object: BibTeX by what it is for."""

    def run(self) -> None:
        """Print the entries, each under what it is for."""
        entries = entries_for(self.used)
        if self.json:
            print(json.dumps(entries))
            return
        for name, text in entries.items():
            print(f"% {name}\n{text}\n")


Shell = Literal["bash", "zsh", "fish"]


@dataclass(frozen=True)
class CompletionCommand:
    """Print a script that completes commands, flags and choices: evnlos completion bash >> ~/.bashrc."""

    shell: Annotated[Shell, tyro.conf.Positional] = "bash"
    """Shell that the script is for."""

    def run(self) -> None:
        """Print the script."""
        print(script(self.shell))


def script(shell: Shell) -> str:
    """Return the completion script of all commands for a shell."""
    from evnlos.cli.main import VERBS, command_of

    commands = {verb: command_of(verb) for verb in VERBS}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog="evnlos",
            args=["--tyro-print-completion", shell],
            config=(tyro.conf.AvoidSubcommands,),
        )
    # Where nothing of ours fits, bash offers files.
    return printed.getvalue().replace("complete -F ", "complete -o default -F ")


_HERE = {
    "captures": "; evnlos lab --set near --out captures renders a set whose checksums the package holds",
    "weights": "; the package evnlos-weights brings them (evnlos weights lists what is there)",
}


_MOST_GB = 1e6  # of one file


@dataclass(frozen=True)
class FetchCommand:
    """Get published captures, weights or examples: each file is checked against its listed SHA-256."""

    kind: Annotated[Literal["captures", "weights", "examples"], tyro.conf.Positional]
    """What to get."""
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Files or folders of the list, e.g. near_R; by default all."""
    out: Path | None = None
    """Folder for the files; by default the kind's name, in this folder. Files that are there already stay."""
    address: tuple[str, ...] = ()
    """Addresses (https://, http://) or folders, the first that answers counts; by default those of the variable
    EVNLOS_DATA."""
    list: bool = False
    """Print what there is; get nothing."""
    force: bool = False
    """Replace files that differ from the published ones."""
    most_gb: float = 2.0
    """Refuse a file that is larger, gigabytes."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> None:
        """Get the files, and print how many."""
        from evnlos.files import fetch_file, has_digest
        from evnlos.machine import ProgressBars, Step

        if not 0 < self.most_gb <= _MOST_GB:
            raise ConfigError(
                f"--most-gb is {self.most_gb:g}; give more than 0 and at most {_MOST_GB:g} (gigabytes)"
            )
        address, listed = self._reached()
        wanted = {
            name: digest
            for name, digest in listed.items()
            if not self.names or any(f"{name}/".startswith(f"{one.rstrip('/')}/") for one in self.names)
        }
        for one in self.names:
            if not any(f"{name}/".startswith(f"{one.rstrip('/')}/") for name in wanted):
                tops = sorted({name.partition("/")[0] for name in listed})
                raise ConfigError(f"{address} has no {one[:80]!r}; give some of {', '.join(tops)[:300]}")
        out = self.out or Path(self.kind)
        if self.list:
            there = {name: has_digest(out / name, digest) for name, digest in wanted.items()}
            lines = [f"{'there' if there[name] else '-':<6}{printable(name)}" for name in wanted]
            print(json.dumps({"address": address, "files": there}) if self.json else "\n".join(lines))
            return
        missing = {name: digest for name, digest in wanted.items() if not has_digest(out / name, digest)}
        if (other := next((name for name in missing if (out / name).exists()), None)) and not self.force:
            raise DataError(f"{out / other} is there and is not the published file; --force replaces it")
        size = 0
        with ProgressBars() as progress:
            for done, (name, digest) in enumerate(missing.items()):
                progress(Step(f"fetch {self.kind}", done, len(missing), "files", within=name))
                try:
                    size += fetch_file(address, self.kind, name, digest, out, int(self.most_gb * 1e9))
                except OSError as error:
                    raise DataError(
                        f"{address}: {name} can't be had ({error}); run the command again"
                    ) from None
            progress(Step(f"fetch {self.kind}", len(missing), len(missing), "files"))
        about = {
            "out": str(out),
            "address": address,
            "files": len(wanted),
            "fetched": len(missing),
            "bytes": size,
        }
        words = (
            f"{out}: {len(wanted)} files as published, {len(missing)} of them fetched now ({size / 1e6:.1f} MB)"
        )
        if self.kind == "weights":
            words += f"; EVNLOS_WEIGHTS={out} lets the commands find them"
        print(json.dumps(about) if self.json else words)

    def _reached(self) -> tuple[str, dict[str, str]]:
        """Return the first address that answers, and its list."""
        from evnlos.files import ADDRESS_VARIABLE, ADDRESSES, published_list

        own = os.environ.get(ADDRESS_VARIABLE, "").split()
        addresses, failed = self.address or (*own, *ADDRESSES), []
        if not addresses:
            raise ConfigError(
                f"no address of published {self.kind} is known; give --address, or set {ADDRESS_VARIABLE} to a "
                f"URL or a folder{_HERE.get(self.kind, '')}"
            )
        for address in addresses:
            try:
                return address, published_list(address, self.kind)
            except (OSError, EvnlosError) as error:
                failed.append(f"{address}: {error}")
        raise DataError(
            f"no published {self.kind} can be reached ({'; '.join(failed)[:400]}); look at the network, or "
            "give --address with another URL or a folder"
        )


@dataclass(frozen=True)
class VerifyCommand:
    """Check every shard of a dataset against its checksums, its name and its settings."""

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset."""
    repair: bool = False
    """Simulate faulty and missing objects again."""
    workers: int = 0
    """Processes for the repair; 0 = one for each core."""
    force: bool = False
    """Begin the repair although the machine's memory will hardly do."""
    json: bool = False
    """Print one JSON object."""

    def check_names(self) -> None:
        """Refuse a dataset that is not there."""
        from evnlos.data import open_dataset

        check_there(open_dataset, self.dataset)

    def run(self) -> None:
        """Check, report, and repair where asked."""
        from evnlos.cli.recordings import result
        from evnlos.data import open_dataset
        from evnlos.data.simulations import find_faults, repair
        from evnlos.data.store import PAGE
        from evnlos.machine import ProgressBars

        dataset = open_dataset(self.dataset)
        total = len(dataset.objects())
        with ProgressBars() as progress:
            faults = find_faults(dataset, progress)
        about = {"dataset": str(self.dataset), "objects": total, "faults": {f.name: f.reason for f in faults}}
        if not self.json:
            for fault in faults:
                place = dataset.folder / PAGE if fault.name == PAGE else dataset.shard(fault.name)
                print(f"{place}: {fault.reason}")
        if not faults:
            result(self.json, about | {"repaired": 0}, f"{self.dataset}: {total} objects, all whole")
        elif not self.repair:
            if self.json:
                print(json.dumps(about | {"repaired": 0}))
            shards = sum(fault.name != PAGE for fault in faults)
            page = f" and {PAGE} is not as it was written" if shards < len(faults) else ""
            raise DataError(
                f"{self.dataset}: {shards} of {total} shards are faulty{page}; --repair makes shards again"
            )
        else:
            with ProgressBars() as progress:
                repair(dataset, faults, self.workers, progress, self.force)
            text = f"{self.dataset}: {len(faults)} of {len(faults)} faulty shards made again"
            result(self.json, about | {"repaired": len(faults)}, text)
