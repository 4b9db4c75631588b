"""The page to play with: a sequence simulated while you watch, or your own recording; Gradio, loaded late."""
