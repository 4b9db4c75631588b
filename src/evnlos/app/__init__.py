"""The page to play with: a pass simulated while you watch, or a recording of your own; Gradio, loaded late."""
