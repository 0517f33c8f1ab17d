"""The semantic pipeline: fine-tuning and speed."""
