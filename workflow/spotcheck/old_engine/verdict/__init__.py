"""The answer: verdict.json and its sentence."""
