"""The texts of the page that stand still: its head, and its words explained."""

HEAD = """<header class="ev-head"><h1>Seeing around a corner</h1>
<p>Something moves behind a corner. Its light falls on a wall; a frame camera and an event camera see
the wall alone. Choose what is hidden and how good the wall and the cameras are, and watch what can be made
of it.</p></header>"""

PAPER = """<div class="ev-paper"><canvas class="ev-pen" width="192" height="192" tabindex="0" role="img"
aria-label="Drawing of the hidden object, 8 cm wide. Arrow keys move the pen, with Shift they draw."></canvas>
<i class="ev-nib"></i><button type="button" class="ev-button" onclick="evnlosClear(this)">Clear</button>
<small>8 cm x 8 cm. Draw with mouse or finger; arrow keys move the pen, with Shift they draw.</small></div>"""
"""The paper of a drawing; `page.js` draws on it."""

_WORDS = {
    "wall roughness": "How far the wall throws light off the direction in which a mirror would. At 0.02 it is "
    "polished metal, at 0.1 it is dull; matte paint throws light everywhere alike.",
    "white level": "A light of 1 white level just fills a pixel of the frame camera.",
    "event": "A pixel of an event camera sends no pictures. It reports when its light has changed by a "
    "threshold, brighter or darker, at that instant.",
    "threshold": "How much the natural logarithm of a pixel's light has to change for an event: 0.15 is 16 %.",
    "time surface": "A picture made from events: each pixel shows how recent its newest event is.",
    "least squares": "The picture that explains one frame best, kept dark where the frame says nothing.",
    "whole pass": "The one picture that explains all frames of the pass together.",
    "dB": "PSNR: ten decibels more are a tenth of the squared error. It means something only beside the value "
    "of an all-black picture at the same instant.",
    "verdict": "What wall and noise leave to be seen in one frame, whatever the method; a whole pass shows "
    "more. Where they leave nothing, a network may still draw a letter: it remembers one.",
}

GLOSSARY = (
    '<details class="ev-words"><summary>What the words mean</summary><dl>'
    + "".join(f"<dt>{word}</dt><dd>{text}</dd>" for word, text in _WORDS.items())
    + "</dl></details>"
)
