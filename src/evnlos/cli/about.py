"""`evnlos cite` and `evnlos completion`: what to quote, and what to type.

- `evnlos cite`: BibTeX for exactly what a simulation, a dataset or a run uses.
- `evnlos completion`: a script that completes commands and flags.
"""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from evnlos.config import read_yaml
from evnlos.errors import DataError
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
