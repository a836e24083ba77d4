"""The torch reference: it defines what a trial computes, for one trial or a batch in lockstep."""
