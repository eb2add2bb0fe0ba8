"""Actors as Pykka has them, run by the event loop or in worker threads: Actor, ActorRef, their life and monitors."""
