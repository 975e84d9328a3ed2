"""The base of transports to policy servers: a template's observation goes up, a chunk of actions comes back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, TypeVar

from s2a_bench.options import option
from s2a_bench.plugins.policy_servers.observation import DEFAULT, Template, TemplateName, names, template_of
from s2a_bench.transport import ACTIONS, Capabilities, Choice, Transport
from s2a_bench.transport.defaults import BESIDE
from s2a_bench.transport.listening import UrlOptions, read_key


class TemplateOptions(UrlOptions):
    """Options of a client that makes its observations from a template."""

    template: TemplateName = option(
        "",
        "the observation: a template's name, or a TOML or JSON file [default: that of the transport or dialect]",
        names=names,
    )


P = TypeVar("P", bound=TemplateOptions)


class PolicyTransport(Transport[P]):
    """Sends observations and receives chunks of actions, both as MessagePack."""

    payloads: ClassVar[tuple[str, ...]] = ("raw", "jpeg", "jpeg-preencoded", "png")
    answer_kinds = (ACTIONS,)
    stages: ClassVar[Mapping[str, str]] = {"msgpack_pack": "pack", "msgpack_parse": "parse"}
    compared_with = BESIDE
    reads_server: ClassVar[Sequence[str]] = ()
    """The keys of `ExternalServer` by which a template may describe the server."""
    usual_template: ClassVar[str] = DEFAULT

    def template(self, options: P) -> Template:
        return template_of(options.template or self.usual_template)

    def capabilities(self, choice: Choice[P]) -> Capabilities[P]:
        options, template = choice.options, self.template(choice.options)
        payloads = self.payloads[1:] if template.encoded else self.payloads
        if options.url and not template.encoded:
            payloads = ("raw", "png", "jpeg") if template.server.image_maps else ("raw",)
        return Capabilities(options, payloads, self.answer_kinds, template.accepts_state, self.facts)

    def require(self, choice: Choice[P]) -> None:
        """Refuse a template that does not fit the requests or the server; raises MissingExtra too."""
        super().require(choice)
        template = self.template(choice.options)
        template.check_request(choice.cameras, choice.state)
        template.check_server(self.name, self.reads_server)
        read_key(getattr(choice.options, "api_key_env", ""))
