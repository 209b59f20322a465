"""What image files say of their frames beside the pixels: tags, texts, files beside them and their own names."""
