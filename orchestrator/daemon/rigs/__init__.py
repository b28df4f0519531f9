"""Queue and rigs: campaigns and ordered pours from their submission to their end, questions, materials and stops."""
