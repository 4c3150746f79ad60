// The extension: three panels for Foxglove and Lichtblick.

import type { ExtensionContext as FoxgloveExtension } from "@foxglove/extension";
import type { ExtensionContext as LichtblickExtension } from "@lichtblick/suite";

import { AutomatonView } from "./automaton";
import { DecisionsView } from "./decisions";
import { SpecificationView } from "./specification";
import { connect, type Context, type View, type Viewer } from "./viewer";

const PANELS: Record<string, new (viewer: Viewer) => View> = {
  "spatial-replay specification": SpecificationView,
  "spatial-replay automaton": AutomatonView,
  "spatial-replay decisions": DecisionsView,
};

export function activate(extension: FoxgloveExtension | LichtblickExtension): void {
  for (const [name, Panel] of Object.entries(PANELS)) {
    extension.registerPanel({
      name,
      initPanel: (context: unknown) => connect(context as Context, (viewer) => new Panel(viewer)),
    });
  }
}
