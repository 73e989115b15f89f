"""Dense matching: block matching, optical flow (Horn-Schunck, Lucas-Kanade), and a hybrid of both."""
