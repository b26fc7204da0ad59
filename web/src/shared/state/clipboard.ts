/** Text for the clipboard, also where the browser has none: outside of secure contexts, as on a phone beside the rig. */

export async function copy(text: string): Promise<void> {
  // A browser without a secure context has no clipboard, whatever the types say.
  const { clipboard } = navigator as { clipboard?: Clipboard };
  if (clipboard !== undefined)
    try {
      await clipboard.writeText(text);
      return;
    } catch {
      // not allowed here: the selection may be
    }
  const area = document.createElement("textarea");
  area.value = text;
  area.readOnly = true;
  area.className = "hidden";
  document.body.append(area);
  const before = document.activeElement;
  area.select();
  // eslint-disable-next-line @typescript-eslint/no-deprecated -- the only way without a secure context
  const copied = document.execCommand("copy");
  area.remove();
  if (before instanceof HTMLElement) before.focus();
  if (!copied) throw new Error(`This browser does not let the page copy. The link is ${text}`);
}
