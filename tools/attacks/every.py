"""All attacks, by name."""

from __future__ import annotations

from collections.abc import Callable

from attacks.cases import Attack
from attacks.clients import Clients
from attacks.code import Code
from attacks.commands import Interrupts, Names
from attacks.damage import Damage
from attacks.kills import Kills
from attacks.results import Results
from attacks.texts import Texts

ATTACKS: dict[str, Callable[[], Attack]] = {
    "kills": Kills,
    "damage": Damage,
    "results": Results,
    "code": Code,
    "texts": Texts,
    "names": Names,
    "interrupts": Interrupts,
    "clients": Clients,
}
