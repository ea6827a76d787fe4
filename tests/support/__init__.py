"""What several tests share: ground truths that share no line with the engine, and where things lie."""
