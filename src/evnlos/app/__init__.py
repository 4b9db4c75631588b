"""The page to play with: a pass simulated while you watch, or a recording of your own; Gradio, loaded late."""

from evnlos.app.recorded import Recorded
from evnlos.app.setup import Setup
from evnlos.app.unpack import unpack_zip

__all__ = ["Recorded", "Setup", "unpack_zip"]
